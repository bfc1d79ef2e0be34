"""Programs that run in the simulated controller."""
