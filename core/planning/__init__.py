"""Which poses to measure, and in which order."""
