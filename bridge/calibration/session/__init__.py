"""A calibration session: its readings, its journal and what it asks of a person."""
