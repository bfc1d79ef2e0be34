"""The simulated controller of Universal Robots."""
