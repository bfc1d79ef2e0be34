"""The status document: what ``gapbridge status --json`` prints and every side process gets."""

from __future__ import annotations

from datetime import datetime
from typing import Any

SCHEMA = "gapbridge.status/1"
AGES = (("ms", 1e-3, 1.0), ("s", 1.0, 120.0), ("min", 60.0, 7200.0), ("h", 3600.0, float("inf")))
"""How an age is shown: unit, its seconds, the age (s) from which the next one is taken."""


def lines(status: dict[str, Any]) -> list[str]:
    """Return a status document as a person reads it."""
    link, loop = status["link"], status["loop"]
    since = f"{datetime.fromtimestamp(status['since']):%H:%M:%S}"
    why = f" ({status['why']})" if status["why"] else ""
    report = [
        f"{status['cell']}: {status['state']} since {since}{why}",
        f"  process {status['pid']}, loop {loop['pid'] or 'none'} (restarts {loop['restarts']}), "
        f"session {status['session']}",
        f"  link: {link['rate_hz']:.1f} Hz, {_last(link['age'])}, cycles "
        f"{link['cycles']}, missed {link['missed']}, late {link['late']}, setpoints "
        f"{link['written']}",
    ]
    if status["armed_by"]:
        report.append(f"  armed by {status['armed_by']}")
    if status["latched"]:
        report.append(f"  fault: {status['latched']}; acknowledge with `gapbridge disarm`")
    if status["correction"]["detail"]:
        report.append(f"  model: {status['correction']['detail']}")
    report.append(f"  joints' zeros: {status['zeros']}")
    counted = {k: v for k, v in status["counts"].items() if v}
    if counted:
        report.append("  counted: " + ", ".join(f"{k} {v}" for k, v in counted.items()))
    for name, side in status["sides"].items():
        report.append(f"  {name}: process {side['pid'] or 'none'} (restarts {side['restarts']})")
    if status["recording"]:
        report.append(f"  recording {status['recording']}")
    return report


def _last(age: float | None) -> str:
    """Return how old the last state is, in the unit of its size."""
    if age is None:
        return "no state yet"
    unit, size = next((unit, size) for unit, size, until in AGES if age < until)
    return f"last state {age / size:.0f} {unit} ago"
