"""Jobs of a calibration session: calibration, verification, payload, tool."""
