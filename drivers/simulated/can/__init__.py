"""Simulated CAN peers and the hub between processes."""
