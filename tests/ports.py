"""Addresses and ports of the tests."""

from benchmarks.ports import free_port, own_host

__all__ = ["free_port", "own_host"]
