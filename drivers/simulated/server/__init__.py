"""The simulated controller's server: links, clock and process."""
