"""Benchmarks of Gapbridge: code that the product does not import and that shares nothing with it."""
