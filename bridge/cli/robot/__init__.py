"""Commands that reach a robot: real, simulated, or led by a person."""
