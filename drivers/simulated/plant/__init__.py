"""The simulated arm: what a real one would do."""
