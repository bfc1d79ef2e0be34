"""Measure fleets: ``python -m benchmarks.fleet [growth|shrinkage]``."""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.fleet import growth, shrinkage

SIZES = (10, 30, 100, 300, 1000)
POSES = [6] * 8 + [8] * 6 + [12] * 4 + [40] * 2


def main() -> None:
    """Measure what is asked for, print it, and write it as JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet", description=__doc__)
    parser.add_argument("what", nargs="*", choices=[[], "growth", "shrinkage"])
    parser.add_argument("--sessions", type=int, default=1000, help="of the growth, at most")
    parser.add_argument("--chunk", type=int, default=50, help="sessions that ways take turns over")
    parser.add_argument("--fleets", type=int, default=12, help="of the shrinkage")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--no-dask", action="store_true")
    parser.add_argument("--no-whole", action="store_true", help="leave out the runs with a start")
    parser.add_argument("--json", type=Path, default=None, help="file for the figures")
    given = parser.parse_args()
    asked = given.what or ["growth", "shrinkage"]
    found: dict[str, Any] = {"load_before": os.getloadavg()[0], "processors": os.cpu_count()}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "growth" in asked:
            found["growth"] = growth.measure(
                folder / "chunks", given.sessions, given.chunk, given.seed, dask=not given.no_dask
            )
            found["whole_s"] = {
                str(n): growth.whole(folder / "whole", n, given.seed)
                for n in SIZES if n <= given.sessions and not given.no_whole
            }  # fmt: skip
        if "shrinkage" in asked:
            found["shrinkage"] = shrinkage.measure(folder / "type", given.fleets, POSES, given.seed)
    found["load_after"] = os.getloadavg()[0]
    text = json.dumps(found, indent=1)
    print(text)
    if given.json is not None:
        given.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
