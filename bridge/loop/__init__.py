"""The loop: one process that reads states, checks them, and writes corrected setpoints."""
