"""Effects of a payload other than declared: in position, wrench and torque."""
