"""Commands that need a robot, real or simulated."""
