"""Counts of a run's cycles, from their rows in shared memory."""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.state import CLAMPS


class CycleCounts:
    """Cycles seen, missed, late and written; ``slices``: where fields are in a cycle's row."""

    def __init__(self, slices: dict[str, slice]) -> None:
        self._slices = slices
        self.cycles = 0  # distinct controller timestamps seen
        self.missed = 0  # timestamps not seen, except those during arming
        self.late = 0  # cycles finished later than one period after their state
        self.written = 0  # setpoints
        self.clamped = dict.fromkeys(CLAMPS, 0)  # setpoints that a limit held back, by limit

    def add(self, rows: Array, rate: float) -> None:
        """Count rows (k, width); ``rate``: nominal cycles per second."""
        s = self._slices
        self.cycles += len(rows)
        self.missed += int(rows[:, s["missed"].start].sum())
        self.late += int((rows[:, s["age"].start] > 1.0 / rate).sum())
        self.written += int(rows[:, s["written"].start].sum())
        bits = rows[:, s["clamped"].start].astype(np.int64)
        for bit, name in enumerate(CLAMPS) if bits.any() else ():
            self.clamped[name] += int((bits >> bit & 1).sum())

    def totals(self) -> dict[str, int]:
        """Return the counts, except those by limit, as status documents and the page hold them."""
        return {
            "cycles": self.cycles, "missed": self.missed, "late": self.late,
            "written": self.written,
        }  # fmt: skip
