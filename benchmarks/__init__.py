"""Benchmarks of Gapbridge: code that shares nothing with the product."""
