"""Sections of a cell file that other packages use."""
