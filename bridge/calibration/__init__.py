"""Field calibration sessions: a technician is led from an unknown arm to a calibrated cell."""
