"""Instruments of a calibration session: one base, one file a member, one table."""
