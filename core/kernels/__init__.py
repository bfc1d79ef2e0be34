"""Compiled loops over many rows: blocks of lanes that the processor works on side by side."""
