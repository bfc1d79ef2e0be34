"""What a calibration session is made for: the whole arm, a check, a payload, a tool."""
