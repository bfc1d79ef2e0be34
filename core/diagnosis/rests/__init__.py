"""Rests of a running arm: what is read there, and what a moved zero of a joint changes."""
