"""What a cycle costs on each link beside the bare library: ``python -m benchmarks.links``."""

from __future__ import annotations

import argparse
import json
import os
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

from benchmarks.links.apart import measured_apart
from benchmarks.links.table import CASES, line, title

PACKAGES = ("ur-rtde", "pymodbus", "python-can", "cantools", "canopen", "numpy", "numba")


def main() -> None:
    """Measure the chosen links, print a line for each, write the figures as JSON."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.links",
        description="What a cycle (read, compensate, write) costs beside the bare library's.",
        epilog="example: python -m benchmarks.links --links modbus,can --rounds 40",
    )
    parser.add_argument(
        "--links", default="", help="only links whose names begin with one of these"
    )
    parser.add_argument("--rounds", type=int, default=24, help="turns of 25 cycles of each side")
    parser.add_argument("--json", type=Path, default=Path("out/link_costs.json"))
    parser.add_argument(
        "--sleep", action="store_true", help="sleep between cycles, so that caches grow cold"
    )
    given = parser.parse_args()
    wanted = tuple(given.links.split(","))
    cases = [case for case in CASES if case.name.startswith(wanted)]
    if not cases:
        parser.error(
            f"--links: found {given.links!r}, expected " + ", ".join(c.name for c in CASES)
        )
    print(title(), flush=True)
    links = []
    for case in cases:
        links.append(measured_apart(case.name, given.rounds, given.sleep))
        print(line(links[-1]), flush=True)
    given.json.parent.mkdir(parents=True, exist_ok=True)
    how = {"between_cycles": "sleep" if given.sleep else "spin"}
    given.json.write_text(json.dumps({**_machine(), **how, "links": links}, indent=1) + "\n")
    print(f"figures in {given.json}")


def _machine() -> dict[str, Any]:
    return {
        "schema": "gapbridge.link_costs/1",
        "python": platform.python_version(),
        "processors": os.cpu_count(),
        "load_average": round(os.getloadavg()[0], 1),
        "packages": {name: version(name) for name in PACKAGES},
    }


if __name__ == "__main__":
    main()
