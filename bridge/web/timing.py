"""How long cycles took lately: counts for a histogram, and the figures beside it."""

from __future__ import annotations

from typing import Any

import numpy as np

from gapbridge.core.arrays import Array

SPAN = 60.0  # s that are looked back
EDGES = np.logspace(-5, -1, 41)  # s: bounds of the bins, ten to a decade


class Timing:
    """Duration of the loop's work and age of the state behind it, over the last minute."""

    def __init__(self) -> None:
        self._rows = np.empty((0, 3))  # time, duration, age; s

    def add(self, time: Array, duration: Array, age: Array) -> None:
        """Take cycles (k,) each."""
        rows = np.concatenate([self._rows, np.column_stack([time, duration, age])])
        self._rows = rows[rows[:, 0] > rows[-1, 0] - SPAN] if len(rows) else rows

    def figures(self) -> dict[str, Any]:
        """Return counts for each bin and p50, p99, max, all in s."""
        return {
            "span": SPAN,
            "edges": EDGES.tolist(),
            "duration": _of(self._rows[:, 1]),
            "age": _of(self._rows[:, 2]),
        }


def _of(values: Array) -> dict[str, Any]:
    values = values[np.isfinite(values)]
    counts, _ = np.histogram(np.clip(values, EDGES[0], EDGES[-1]), EDGES)
    found: dict[str, Any] = {"counts": counts.tolist(), "p50": None, "p99": None, "max": None}
    if len(values):
        p50, p99 = np.quantile(values, (0.5, 0.99))
        found |= {"p50": float(p50), "p99": float(p99), "max": float(values.max())}
    return found
