"""What the page draws over time: cycles thinned to a few points a second, for so many seconds."""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array

STEP = 0.05  # s that one point stands for

COLUMNS = (
    "time", "state",
    "offset_x", "offset_y", "offset_z", "offset_rx", "offset_ry", "offset_rz",
    "measured_fx", "measured_fy", "measured_fz", "measured_mx", "measured_my", "measured_mz",
    "predicted_fx", "predicted_fy", "predicted_fz", "predicted_mx", "predicted_my", "predicted_mz",
)  # fmt: skip
"""time: s since the epoch; state: number; offsets: m and rad in base; wrenches: N and Nm, their
axes as the page is given; NaN where there is none."""
OFFSET, MEASURED, PREDICTED = slice(2, 8), slice(8, 14), slice(14, 20)


class History:
    """A ring of points. Offsets are those of the cycle in which they were largest, wrenches means.

    So a peak is never thinned away.
    """

    def __init__(self, length: float) -> None:
        self._most = max(int(length / STEP), 1)
        self._points = np.empty((0, len(COLUMNS)))
        self._pending = np.empty((0, len(COLUMNS)))  # cycles of a point that is not whole

    def add(self, cycles: Array, now: float) -> Array:
        """Take cycles (k, columns) in order of time; returns the points that are whole by now."""
        pending = np.concatenate([self._pending, cycles])
        if not len(pending):
            return pending
        slot = np.floor(pending[:, 0] / STEP)
        open_slot = np.floor(now / STEP)
        whole = slot < open_slot
        self._pending = pending[~whole]
        points = thinned(pending[whole], slot[whole])
        self._points = np.concatenate([self._points, points])[-self._most :]
        return points

    def since(self, seconds: float, most: int) -> Array:
        """Return the points (k, columns) of the last ``seconds``, thinned to ``most`` or fewer."""
        points = self._points
        if len(points):
            points = points[points[:, 0] > points[-1, 0] - seconds]
        if len(points) <= most:
            return points
        length = seconds / most
        return thinned(points, np.floor(points[:, 0] / length))


def thinned(cycles: Array, slot: Array) -> Array:
    """Return one point for each run of equal slots (k,)."""
    if not len(cycles):
        return cycles
    starts = np.flatnonzero(np.diff(slot, prepend=np.nan) != 0)
    ends = np.append(starts[1:], len(cycles))
    points = np.empty((len(starts), cycles.shape[1]))
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        part = cycles[start:end]
        points[i] = part[-1]
        size = np.nan_to_num(np.abs(part[:, OFFSET])).max(axis=1)
        points[i, OFFSET] = part[int(np.argmax(size)), OFFSET]
        for columns in (MEASURED, PREDICTED):
            points[i, columns] = _mean(part[:, columns])
    return points


def _mean(rows: Array) -> Array:
    """Return the mean of the finite rows, NaN where there is none."""
    fine = rows[np.isfinite(rows).all(axis=1)]
    return fine.mean(axis=0) if len(fine) else np.full(rows.shape[1], np.nan)
