"""Metrics for Prometheus: a side process that counts what the daemon does."""
