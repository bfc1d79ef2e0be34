"""Whole runs in simulated time: the product's own loop and daemon, every link, one seed.

Everything that is not deterministic is replaced at its edge: the clock, the wires, the processes.
What runs in between is the product as it is. The same seed makes the same run to the last bit.
"""
