"""The report of a calibration, for the customer."""
