"""Sections of a cell file that other folders run by."""
