"""The figures of docs/evidence.md: each module prints its own, ``python -m`` from the root."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
DATA = ROOT.parent / "shared" / "data"
