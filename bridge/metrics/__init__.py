"""Metrics for Prometheus: a process of its own that counts what the daemon does."""
