"""Both sides in turns within one run; medians, quartiles, ratios.

Each round calls every side once, in an order that changes from round to round, so that whatever
else the machine does meets all of them. What counts is the CPU time of the calling thread: wall
time besides, for work on several threads and for waiting.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

Call = Callable[[], object]


@dataclass(frozen=True)
class Side:
    """One way to do the work: ``call`` does it ``work`` times."""

    name: str
    call: Call
    work: int = 1


def interleaved(sides: list[Side], rounds: int) -> dict[str, dict[str, Any]]:
    """Return the figures of each side in s for one piece of work, after one untimed round."""
    taken: dict[str, list[tuple[float, float]]] = {side.name: [] for side in sides}
    for side in sides:
        side.call()
    for turn in range(rounds):
        first = turn % len(sides)
        for side in sides[first:] + sides[:first]:
            wall, busy = time.perf_counter(), time.thread_time()
            side.call()
            busy = time.thread_time() - busy
            taken[side.name].append(((time.perf_counter() - wall) / side.work, busy / side.work))
    return {name: _figures(np.array(values)) for name, values in taken.items()}


def _figures(values: np.ndarray) -> dict[str, Any]:
    found: dict[str, Any] = {"rounds": len(values)}
    for kind, column in zip(("wall_s", "cpu_s"), values.T, strict=True):
        low, middle, high = np.percentile(column, [25, 50, 75])
        found[kind] = {
            "median": middle, "p25": low, "p75": high, "min": float(column.min()),
            "all": [float(value) for value in column],
        }  # fmt: skip
    return found


def ratio(figures: dict[str, dict[str, Any]], peer: str, ours: str, kind: str = "cpu_s") -> Any:
    """Return peer by ours: of the medians, and quartiles and extremes over the rounds' pairs."""
    pairs = np.array(figures[peer][kind]["all"]) / np.array(figures[ours][kind]["all"])
    low, high = np.percentile(pairs, [25, 75])
    medians = figures[peer][kind]["median"] / figures[ours][kind]["median"]
    return {"median": float(medians), "p25": float(low), "p75": float(high), "kind": kind}


def compared(
    name: str, goal: str, figures: dict[str, dict[str, Any]], pairs: list[tuple[str, str]],
    kind: str = "cpu_s", **more: Any,
) -> dict[str, Any]:  # fmt: skip
    """Return a row of the report: figures of all sides, and peer/ours for each of ``pairs``."""
    ratios = [
        {"peer": peer, "ours": ours, **ratio(figures, peer, ours, kind)} for peer, ours in pairs
    ]
    return {"row": name, "goal": goal, "sides": figures, "ratios": ratios, **more}
