"""Validation on all rows of a log: refitted at once, or block by block of a long recording."""
