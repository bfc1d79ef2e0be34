"""The data that the page shows, updated from the shared memory and the daemon's events.

Time series are thinned to a few points a second.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.ipc.cycle_counts import CycleCounts
from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.loop_state import State, has_link
from gapbridge.bridge.ipc.shared_memory import ROWS, SharedMemory
from gapbridge.bridge.ipc.updated_settings import UpdatedSettings
from gapbridge.bridge.web.prediction import Prediction
from gapbridge.core.arrays import Array
from gapbridge.drivers.clock import Clock

Message = tuple[str, dict[str, Any]]  # kind, data
ENDS = (EventKind.FAULT, EventKind.FAILURE)  # events with which a process of the loop ends
EVENTS = 200  # stored to be shown
TIMING_EVERY = 1.0  # s
ARM_EVERY = 0.2  # s
RATE_SPAN = 2.0  # s over which the rate is averaged
DIGITS = 6  # significant digits of drawn values
SPAN = 60.0  # s of the timing histograms
EDGES = np.logspace(-5, -1, 41)  # s: bounds of the bins, ten to a decade
STEP = 0.05  # s of one point

COLUMNS = (
    "time", "state",
    "offset_x", "offset_y", "offset_z", "offset_rx", "offset_ry", "offset_rz",
    "measured_fx", "measured_fy", "measured_fz", "measured_mx", "measured_my", "measured_mz",
    "predicted_fx", "predicted_fy", "predicted_fz", "predicted_mx", "predicted_my", "predicted_mz",
)  # fmt: skip
"""time: s since the epoch; state: number; offsets: m and rad in base; wrenches: N and Nm, axes
as the page names them; NaN if there is none."""
OFFSET, MEASURED, PREDICTED = slice(2, 8), slice(8, 14), slice(14, 20)


class PageData:
    """Collects the data; ``update`` returns messages on what is new since the last call.

    ``extra``: the cell file's ``text`` and the ``digests`` of all its files, as the daemon has read
    them.
    """

    def __init__(
        self,
        settings: DaemonSettings,
        n: int,
        session: str,
        memory: SharedMemory,
        clock: Clock,
        extra: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        assert settings.web is not None
        self._updated = UpdatedSettings(settings, extra.get("text"))
        self._digests: dict[str, str] | None = extra.get("digests")
        self._clock = clock
        self._session, self._memory = session, memory
        self._slices, self._n = memory.slices, n
        # a page opened late shows what the ring holds
        self._reader = memory.reader(max(memory.written - ROWS + ROWS // 4, 0))
        self._prediction = Prediction(settings, memory.slices, self._digests)
        self._history = History(settings.web.history)
        self._timing = Timing()
        self._timing_at = self._arm_at = 0.0
        self._row: Array | None = None  # the last cycle
        self._down = False  # the loop has ended and no other is connected
        self._no_loop = False  # the same, by the status: the end was before this process began
        self._times = np.empty(0)  # s, monotonic, of the last cycles
        self.events: deque[dict[str, Any]] = deque(maxlen=EVENTS)
        self.status: dict[str, Any] = {}
        self._why: dict[str, Any] = {}  # the last transition
        self._counts = CycleCounts(memory.slices)
        self._last = 0.0  # s, monotonic: when the last state was received
        self._sensor = "actual_TCP_force"

    @property
    def _settings(self) -> DaemonSettings:
        return self._updated.settings

    # -- in ---------------------------------------------------------------------------------------

    def update(self, events: list[dict[str, Any]]) -> list[Message]:
        """Process new events and cycles; returns messages for the open pages."""
        messages = [message for event in events for message in self._on_event(event)]
        changed = [self._updated.on_event(event) for event in events]
        if any(changed) or any(event.get("kind") == EventKind.CELL for event in events):
            self._prediction = Prediction(self._settings, self._slices, self._digests)
        if any(changed):
            messages.append(("hello", self.snapshot()))  # limits and rate may have changed
        points = self._take(self._reader.drain())
        messages.append(("tick", {**self.now(), "points": plain(points)}))
        now = self._clock.monotonic()
        if now >= self._timing_at:
            self._timing_at = now + TIMING_EVERY
            messages.append(("timing", self._timing.figures()))
        if now >= self._arm_at and self._row is not None:
            self._arm_at = now + ARM_EVERY
            arm = self._prediction.arm(self._row)
            messages += [] if arm is None else [("arm", arm)]
        return messages

    def _on_event(self, event: dict[str, Any]) -> list[Message]:
        if event.get("kind") == EventKind.STATUS:
            self.status = event
            self._no_loop = "state" in event and not has_link(event["state"])
            return [("status", event)]
        if event.get("kind") == EventKind.CELL:  # not for pages: it has the cell's secrets
            self._digests = event["digests"]
            return []
        if "to" in event:
            self._why = event
            self._down, self._no_loop = event["to"] == State.DISCONNECTED.name, False
        elif event.get("kind") in ENDS:
            # since when it is down is the first end's time; why, the newest one's
            since = self._why["time"] if self._down else event["time"]
            self._why = {"cause": "", "detail": event["detail"], "time": since}
            self._down = True
        self.events.append(event)
        return [("event", event)]

    def _take(self, rows: Array) -> Array:
        s, now = self._slices, self._clock.monotonic()
        wall = self._clock.time() - now
        cycles = np.full((len(rows), len(COLUMNS)), np.nan)
        if len(rows):
            received, age = rows[:, s["received"].start], rows[:, s["age"].start]
            rate = self._settings.link.rate
            self._counts.add(rows, rate)
            self._last, self._row = float(received[-1]), rows[-1].copy()
            times = np.concatenate([self._times, received])
            self._times = times[times > times[-1] - RATE_SPAN]
            self._timing.add(received, rows[:, s["duration"].start], age)
            wrench = rows[:, s["ft_raw_wrench"]]
            self._sensor = "actual_TCP_force" if np.isnan(wrench).all() else "ft_raw_wrench"
            cycles[:, 0], cycles[:, 1] = received + wall, rows[:, s["state"].start]
            cycles[:, 2:8] = rows[:, s["offset"]]
            cycles[:, 8:14] = rows[:, s[self._sensor]]
            # a few cycles for each point: points are means
            step = max(int(rate * STEP / 2), 1)
            picked = np.arange(len(rows) - 1, -1, -step)[::-1]
            cycles[picked, 14:20] = self._prediction.wrenches(rows[picked])
        return self._history.add(cycles, now + wall)

    # -- out --------------------------------------------------------------------------------------

    def now(self) -> dict[str, Any]:
        """Return the present state, rate and counts."""
        times, now = self._times, self._clock.monotonic()
        silence = now - self._last if self._last else None
        alive = len(times) > 1 and silence is not None and silence < RATE_SPAN
        rate = (len(times) - 1) / (times[-1] - times[0]) if alive else 0.0
        state = State.DISCONNECTED if self._down or self._no_loop else State(self._memory.state)
        return {
            "time": self._clock.time(),
            "state": state.name.lower(),
            "phase": self._memory.phase.name.lower(),
            "why": {k: v for k, v in self._why.items() if k in ("cause", "detail", "time")},
            "silence": silence,  # s since the last state of the robot
            "heartbeat": self._memory.silence,  # s since the loop's last sign of life
            "rate": rate,
            "sensor": self._sensor,
            "clamped": self._counts.clamped,
            "lost": self._reader.lost,
            **self._counts.totals(),
        }

    def about(self) -> dict[str, Any]:
        """Return what does not change during a run."""
        settings = self._settings
        return {
            "session": self._session,
            "cell": settings.cell.stem,
            "driver": settings.link.driver,
            "rate": settings.link.rate,
            "joints": self._n,
            "limits": settings.limits.model_dump(mode="json"),
            "columns": COLUMNS,
            "states": [state.name.lower() for state in State],
        }

    def snapshot(self) -> dict[str, Any]:
        """Return everything but the history."""
        return {
            **self.about(),
            "now": self.now(),
            "status": self.status,
            "timing": self._timing.figures(),
            "events": list(self.events),
        }

    def history(self, seconds: float, most: int) -> dict[str, Any]:
        """Return the last ``seconds`` of the time series, in ``most`` points or fewer."""
        return {
            "session": self._session,
            "columns": COLUMNS,
            "points": plain(self._history.since(seconds, most)),
        }


def plain(points: Array) -> list[list[float | None]]:
    """Return points for JSON: None for NaN, six digits, times rounded to ms."""
    return [
        [
            round(row[0], 3),
            *(float(f"{v:.{DIGITS}g}") if math.isfinite(v) else None for v in row[1:]),
        ]
        for row in points.tolist()
    ]


class Timing:
    """Durations of the loop's cycles and ages of their states, over the last SPAN s."""

    def __init__(self) -> None:
        self._rows = np.empty((0, 3))  # time, duration, age; s

    def add(self, time: Array, duration: Array, age: Array) -> None:
        """Add cycles: arrays (k,), s."""
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
    figures: dict[str, Any] = {"counts": counts.tolist(), "p50": None, "p99": None, "max": None}
    if len(values):
        p50, p99 = np.quantile(values, (0.5, 0.99))
        figures |= {"p50": float(p50), "p99": float(p99), "max": float(values.max())}
    return figures


class History:
    """A ring of points. Wrenches are means; offsets are of the cycle with the largest one.

    So thinning keeps peaks of the offset.
    """

    def __init__(self, length: float) -> None:
        self._most = max(int(length / STEP), 1)
        self._points = np.empty((0, len(COLUMNS)))
        self._pending = np.empty((0, len(COLUMNS)))  # cycles of an incomplete point

    def add(self, cycles: Array, now: float) -> Array:
        """Add cycles (k, columns) in time order; returns the points that are complete now.

        What is later than ``now`` is from before the clock was set back, and is dropped.
        """
        pending = np.concatenate([self._pending, cycles])
        pending = pending[pending[:, 0] <= now]
        if len(self._points) and self._points[-1, 0] > now:
            self._points = self._points[self._points[:, 0] <= now]
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
        slot = np.floor((points[-1, 0] - points[:, 0]) * most / seconds)
        return thinned(points, np.minimum(slot, most - 1))


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
