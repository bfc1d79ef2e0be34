"""Speed beside peers: ``python -m benchmarks.speed``."""

from __future__ import annotations

import argparse
import json
import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from benchmarks.speed import diagnosis, geometry, growth, loop, rows, setpoint, start

PACKAGES = ("numpy", "scipy", "numba", "pin", "casadi")
PARTS = ("setpoint", "loop", "rows", "geometry", "start", "diagnosis", "growth")


def main() -> None:
    """Measure the chosen parts, print a line per ratio, write all figures as JSON."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.speed",
        description="Speed beside peers, in turns within one run; CPU time, medians, quartiles.",
        epilog="example: python -m benchmarks.speed --parts setpoint,rows --rounds 20",
    )
    parser.add_argument("--out", type=Path, default=Path("out/speed.json"))
    parser.add_argument("--parts", default=",".join(PARTS), help=f"of {', '.join(PARTS)}")
    parser.add_argument("--rounds", type=int, default=15, help="turns of each side")
    parser.add_argument("--rows", type=int, default=1_000_000, help="of the fit")
    parser.add_argument("--poses", type=int, default=1000, help="of the calibrations")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the daemon's loop")
    parser.add_argument(
        "--growth", default=",".join(growth.KINDS), help=f"by what, of {', '.join(growth.KINDS)}"
    )
    given = parser.parse_args()
    chosen = given.parts.split(",")
    if unknown := set(chosen) - set(PARTS):
        parser.error(f"--parts: found {', '.join(sorted(unknown))}, expected of {', '.join(PARTS)}")
    measured: dict[str, Any] = {**_machine(), "rows": []}
    # more threads never helped matrices of a dozen columns, and spin where others want to work
    with threadpool_limits(1):
        for made in _measured(chosen, given):
            for line in lines(made):
                print(line, flush=True)
            measured["rows"].append(_short(made))
            _write(given.out, measured)
        if "growth" in chosen:
            measured["growth"] = growth.growth(given.growth.split(","))
    measured["load_average_after"] = os.getloadavg()[0]
    _write(given.out, measured)
    print(f"figures in {given.out}")


def _measured(chosen: list[str], given: argparse.Namespace) -> Any:
    """Yield row after row."""
    few = max(given.rounds // 2, 3)
    if "setpoint" in chosen:
        yield setpoint.hot(given.rounds)
        yield setpoint.cold(given.rounds)
        yield setpoint.stream(given.rounds)
    if "loop" in chosen:
        yield loop.loop(given.seconds)
    if "rows" in chosen:
        yield rows.fit(given.rows, few)
    if "geometry" in chosen:
        yield geometry.linear(given.poses, max(given.rounds // 5, 1))
        yield geometry.whole(given.poses, max(given.rounds // 10, 1))
    if "start" in chosen:
        yield start.start(few)
    if "diagnosis" in chosen:
        yield diagnosis.diagnosis()


def lines(made: dict[str, Any]) -> list[str]:
    """Return a row of the report as text."""
    found = [f"{made['row']} (goal: {made['goal']})"]
    for name, side in made["sides"].items():
        cpu, wall = side["cpu_s"]["median"], side["wall_s"]["median"]
        p99 = f", p99 {_time(side['wall_s']['p99'])}" if "p99" in side["wall_s"] else ""
        found.append(f"  {name:42s} CPU {_time(cpu):>10s}  wall {_time(wall):>10s}{p99}")
    for one in made["ratios"]:
        spread = f"{one['p25']:.3g} to {one['p75']:.3g}"
        found.append(f"  {one['peer']} / {one['ours']}: {one['median']:.3g} ({spread})")
    known = ("row", "goal", "sides", "ratios", "profile")
    found += [f"  {key}: {value}" for key, value in made.items() if key not in known]
    return found


def _time(seconds: float) -> str:
    for unit, factor in (("s", 1.0), ("ms", 1e3), ("us", 1e6)):
        if seconds * factor >= 1.0:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def _short(made: dict[str, Any]) -> dict[str, Any]:
    """Return a row without the single times: medians, quartiles and ratios say it."""
    for side in made["sides"].values():
        for kind in ("wall_s", "cpu_s"):
            side[kind].pop("all", None)
    return made


def _machine() -> dict[str, Any]:
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return {
        "schema": "gapbridge.speed/1", "python": platform.python_version(),
        "machine": platform.machine(), "processors": os.cpu_count(),
        "load_average_before": os.getloadavg()[0], "packages": found,
    }  # fmt: skip


def _write(path: Path, measured: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(measured, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
