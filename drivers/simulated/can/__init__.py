"""Simulated CAN arms and the hub between processes."""
