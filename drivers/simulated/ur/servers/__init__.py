"""The ports of the simulated controller."""
