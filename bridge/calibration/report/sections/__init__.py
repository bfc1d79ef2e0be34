"""The sections of each kind of calibration report."""
