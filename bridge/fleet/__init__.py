"""Diagnosis and fit of fleets: many arms, many sessions."""
