"""Speed beside peers, interleaved in one run: `python -m benchmarks.speed`."""
