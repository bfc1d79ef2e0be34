"""A calibration session: journal, prompts, positioning of the arm, readings and their checks."""
