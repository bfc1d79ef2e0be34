"""Calibration of an arm: which poses to measure, the fit of all parameters, how far it carries."""
