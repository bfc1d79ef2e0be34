"""What a log measures, as equations of a regression: position, wrench, torque, tracking."""
