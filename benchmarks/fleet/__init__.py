"""Fleets: how they grow, and what the hierarchical fit is worth."""
