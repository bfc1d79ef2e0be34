"""Field calibration: guided sessions that measure an arm and write a calibrated cell."""
