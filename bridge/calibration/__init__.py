"""The field calibration session: plan, instruments, capture, fit, report."""
