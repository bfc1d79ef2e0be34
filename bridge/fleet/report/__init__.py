"""The report of a fleet: one self-contained HTML file."""
