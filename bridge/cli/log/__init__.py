"""Commands that read logs: one, many, or the benchmark's."""
