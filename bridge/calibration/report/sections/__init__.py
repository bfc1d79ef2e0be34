"""The sections of the calibration reports."""
