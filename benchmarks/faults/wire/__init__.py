"""What goes over a wire, decoded by code of its own: nothing here is the driver's or the limiter's.

Offsets, joints and states are read from the bytes alone; see tap.py and invariants.py.
"""
