"""The summary of a run: figures and text."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.ipc.cycle_counts import CycleCounts
from gapbridge.bridge.ipc.shared_memory import slices_of
from gapbridge.core.arrays import Array

UNIT = 1e-6  # s: bin of a histogram
BATCH = 50  # batches of rows that are counted together
MOST_FAULTS = 20  # texts kept of the first faults of a run, and of the last ones
BINS = 50_000  # to 50 ms; longer durations count in the last bin


class Histogram:
    """Counts of durations, exact to 1 us."""

    def __init__(self) -> None:
        self._counts = np.zeros(BINS, dtype=np.int64)
        self.largest = 0.0  # s

    def add(self, values: Array) -> None:
        """Count durations (k,), s."""
        if len(values):
            bins = np.minimum(np.maximum(values / UNIT, 0.0), BINS - 1).astype(int)
            np.add.at(self._counts, bins, 1)
            self.largest = max(self.largest, float(values.max()))

    def quantile(self, share: float) -> float:
        """Return a quantile of the durations, s; 0 without any."""
        total = self._counts.sum()
        if not total:
            return 0.0
        index = int(np.searchsorted(np.cumsum(self._counts), share * total))
        return min((index + 1) * UNIT, self.largest)


class Faults:
    """The faults of a run: a link that is lost for days is lost thousands of times."""

    def __init__(self) -> None:
        self.cause = ""  # of the first one
        self._first: list[str] = []
        self._last: deque[str] = deque(maxlen=MOST_FAULTS)
        self._left_out = 0

    def add(self, cause: str, text: str) -> None:
        """Take a fault."""
        self.cause = self.cause or cause
        if len(self._first) < MOST_FAULTS:
            self._first.append(text)
            return
        self._left_out += len(self._last) == MOST_FAULTS
        self._last.append(text)

    @property
    def texts(self) -> tuple[str, ...]:
        """Return the first and the last ones, and in between how many others there were."""
        between = [f"{self._left_out} others"] if self._left_out else []
        return (*self._first, *between, *self._last)


@dataclass(frozen=True)
class RunSummary:
    """One run of the daemon. Times in ms and us as the names say."""

    cycles: int  # distinct controller timestamps seen
    missed: int  # timestamps not seen, except those during arming
    late: int  # cycles finished later than one period after their state
    rate_hz: float  # cycles per second of the controller's clock
    setpoints_written: int
    age_ms: dict[str, float]  # p50, p99, max: age of the state behind each setpoint
    loop_us: dict[str, float]  # p50, p99, max: from seeing a state to having written
    clamped: dict[str, int]  # setpoints that a limit held back, by limit
    restarts: int  # of the loop's process
    lost_rows: int  # cycles that could not be recorded
    faults: tuple[str, ...]
    state: str  # at the end
    exit_code: int
    recording: Path | None = None
    cause: str = ""  # of the first fault: a Cause, or "loop" where its process ended

    @property
    def missed_share(self) -> float:
        """Return missed cycles over all there were."""
        return self.missed / max(self.cycles + self.missed, 1)

    def to_json(self) -> dict[str, Any]:
        """Return everything as JSON-able data."""
        document = asdict(self)
        document["recording"] = None if self.recording is None else str(self.recording)
        document["missed_share"] = self.missed_share
        return document

    def lines(self) -> list[str]:
        """Return the summary as a person reads it."""
        lines = [
            f"cycles {self.cycles}, missed {self.missed} ({100 * self.missed_share:.3f} %), "
            f"late {self.late}, rate {self.rate_hz:.2f} Hz",
            f"setpoints written {self.setpoints_written}, age of the state p50 "
            f"{self.age_ms['p50']:.2f} ms, p99 {self.age_ms['p99']:.2f} ms, max "
            f"{self.age_ms['max']:.2f} ms",
            f"loop p50 {self.loop_us['p50']:.0f} us, p99 {self.loop_us['p99']:.0f} us, max "
            f"{self.loop_us['max']:.0f} us",
        ]
        clamped = ", ".join(f"{name} {count}" for name, count in self.clamped.items() if count)
        if clamped:
            lines.append(f"held back by limits: {clamped}")
        if self.restarts:
            lines.append(f"the loop's process was restarted {self.restarts} times")
        if self.lost_rows:
            lines.append(f"{self.lost_rows} cycles could not be recorded")
        if self.recording is not None and not 0 < self.cycles <= self.lost_rows:
            lines.append(f"recorded in {self.recording}")
        return lines


@dataclass
class Tally:
    """Counts the cycles of a run as they come in, across restarts of the loop's process."""

    n: int
    rate: float
    counts: CycleCounts = field(init=False)
    last_timestamp: float = np.nan  # s, controller's clock
    steps: int = 0  # between two cycles in a row
    span: float = 0.0  # s of the controller's clock that they took
    age: Histogram = field(default_factory=Histogram)
    age_written: Histogram = field(default_factory=Histogram)
    work: Histogram = field(default_factory=Histogram)
    waiting: list[Array] = field(default_factory=list)  # rows that are not counted yet

    def __post_init__(self) -> None:
        self.counts = CycleCounts(slices_of(self.n))

    def add(self, rows: Array) -> None:
        """Count rows (k, width) of consecutive cycles."""
        if len(rows):
            self.waiting.append(rows)
            if len(self.waiting) >= BATCH:
                self._count()

    def _count(self) -> None:
        """Count the queued rows together: a call on many rows costs as much as one on a few."""
        if not self.waiting:
            return
        rows, self.waiting = np.concatenate(self.waiting), []
        s = slices_of(self.n)
        written = rows[:, s["written"].start] > 0
        age, work = rows[:, s["age"].start], rows[:, s["duration"].start]
        missed = rows[:, s["missed"].start]
        self.counts.add(rows, self.rate)
        stamps = rows[:, s["timestamp"].start]
        gaps = stamps.copy()
        gaps[1:] -= stamps[:-1]
        gaps[0] -= self.last_timestamp
        # a gap without missed cycles: the loop was arming, or was restarted
        gaps = gaps[np.abs(gaps - (missed + 1.0) / self.rate) < 0.5 / self.rate]
        self.last_timestamp = float(stamps[-1])
        self.steps += len(gaps)
        self.span += float(gaps.sum())
        self.age.add(age)
        self.age_written.add(age[written])
        self.work.add(work)

    def figures(self) -> dict[str, Any]:
        """Return the fields of RunSummary that are counted here."""
        self._count()
        quantiles = {"p50": 0.5, "p99": 0.99}
        # a run that only observes has no setpoints; then every cycle counts
        ages = self.age_written if self.counts.written else self.age
        age = {k: 1e3 * ages.quantile(v) for k, v in quantiles.items()}
        work = {k: 1e6 * self.work.quantile(v) for k, v in quantiles.items()}
        return {
            "cycles": self.counts.cycles,
            "missed": self.counts.missed,
            "late": self.counts.late,
            "rate_hz": self.steps / self.span if self.span else 0.0,
            "setpoints_written": self.counts.written,
            "age_ms": age | {"max": 1e3 * ages.largest},
            "loop_us": work | {"max": 1e6 * self.work.largest},
            "clamped": dict(self.counts.clamped),
        }


def places(settings: DaemonSettings) -> Iterator[str]:
    """Yield where a run is watched, and where its setpoints are written to, as text."""
    if settings.web is not None:
        yield f"status page: {settings.web.url}"
    if settings.setpoints.source == "planner":
        yield f"setpoints: a planner writes to {settings.setpoints.socket}"
