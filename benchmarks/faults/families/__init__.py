"""Families of faults, one a file; table.py lists them all."""
