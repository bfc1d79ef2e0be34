"""What is counted: from the cycles in the shared page, and from what the daemon reports."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.reread import RereadSettings
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.core.arrays import Array
from gapbridge.core.limits import CLAMPS

AGE_BOUNDS = (0.00025, 0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128)  # s
WORK_BOUNDS = (0.00005, 0.0001, 0.0002, 0.0004, 0.0008, 0.0016, 0.0032, 0.0064, 0.0128)  # s


class Buckets:
    """A histogram with fixed upper bounds, s."""

    def __init__(self, bounds: tuple[float, ...]) -> None:
        self.bounds = bounds
        self._counts = np.zeros(len(bounds) + 1, dtype=np.int64)
        self.sum = 0.0

    def add(self, values: Array) -> None:
        """Count values (k,); what is no number is left out."""
        values = values[np.isfinite(values)]
        places = np.searchsorted(self.bounds, values)
        self._counts += np.bincount(places, minlength=len(self._counts))
        self.sum += float(values.sum())

    def cumulative(self) -> list[tuple[str, float]]:
        """Return (upper bound as text, values up to it), as Prometheus wants them."""
        names = [*(f"{bound:g}" for bound in self.bounds), "+Inf"]
        return [(n, float(c)) for n, c in zip(names, np.cumsum(self._counts), strict=True)]


class Counts:
    """Everything that is counted since this process began to read, and the last of what changes."""

    def __init__(
        self, page: SharedMemory, settings: DaemonSettings, text: str | None = None
    ) -> None:
        self._page, self._slices = page, page.slices
        self._reread = RereadSettings(settings, text)  # text: the cell file's
        self._reader = page.reader()
        self.cycles = self.missed = self.late = self.written = 0
        self.clamped = dict.fromkeys(CLAMPS, 0)
        self.age, self.work = Buckets(AGE_BOUNDS), Buckets(WORK_BOUNDS)
        self.offset = np.full(6, np.nan)  # m, rad
        self.received = 0.0  # s, monotonic
        self.transitions: Counter[tuple[str, str]] = Counter()  # to, cause
        self.events: Counter[str] = Counter()
        self.faults: Counter[str] = Counter()
        self.status: Mapping[str, Any] = {}
        self.recorder_lost = 0  # cycles
        self.recorder_paused = False

    @property
    def settings(self) -> DaemonSettings:
        """Return the settings of the run by now."""
        return self._reread.settings

    @property
    def lost(self) -> int:
        """Return the cycles that were overwritten before they could be counted."""
        return self._reader.lost

    @property
    def silence(self) -> float:
        """Return s since the last state of the robot; infinite before the first."""
        return time.monotonic() - self.received if self.received else float("inf")

    @property
    def state(self) -> int:
        """Return the supervisor's state."""
        return self._page.state

    @property
    def heartbeat(self) -> float:
        """Return s since the loop's last sign of life."""
        return self._page.silence

    def turn(self, events: list[dict[str, Any]]) -> None:
        """Take what has come."""
        for event in events:
            self._on_event(event)
        rows, s = self._reader.drain(), self._slices
        if not len(rows):
            return
        age = rows[:, s["age"].start]
        self.cycles += len(rows)
        self.missed += int(rows[:, s["missed"].start].sum())
        self.late += int((age > 1.0 / self.settings.link.rate).sum())
        self.written += int(rows[:, s["written"].start].sum())
        bits = rows[:, s["clamped"].start].astype(np.int64)
        for bit, name in enumerate(CLAMPS):
            self.clamped[name] += int((bits >> bit & 1).sum())
        self.age.add(age)
        self.work.add(rows[:, s["duration"].start])
        self.offset = rows[-1, s["offset"]]
        self.received = float(rows[-1, s["received"].start])

    def _on_event(self, event: dict[str, Any]) -> None:
        kind = str(event.get("kind", "note"))
        self._reread.on_event(event)
        if kind == "status":
            self.status = event
            return
        self.events[kind] += 1
        if kind == "recorder":
            self.recorder_paused = bool(event.get("paused"))
            self.recorder_lost += int(event.get("lost") or 0)
        if kind == "fault":
            self.faults[str(event.get("cause") or "other")[:60]] += 1
        if "to" in event:
            to, cause = str(event["to"]).lower(), str(event.get("cause", ""))
            self.transitions[to, cause] += 1
            if to == "fault":
                self.faults[cause] += 1
