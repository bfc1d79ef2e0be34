"""Benchmarks of calibration sessions: planning, coverage, verified error, other programs."""
