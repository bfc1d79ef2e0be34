"""A recording of the daemon as a controller."""
