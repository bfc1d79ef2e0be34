"""The metrics' process: ``python -m gapbridge.bridge.metrics.main``, started by the daemon.

It reads shared memory and events, and answers Prometheus at /metrics. Names, units and help texts
follow Prometheus' conventions.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.document.output_file import printable
from gapbridge.bridge.ipc.cycle_counts import CycleCounts
from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.loop_counters import DROPPED
from gapbridge.bridge.ipc.loop_state import State, has_link
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.ipc.side_main import StartData, run_side
from gapbridge.bridge.ipc.updated_settings import UpdatedSettings
from gapbridge.bridge.recording.folder import segments
from gapbridge.bridge.served.credentials import read_token
from gapbridge.bridge.served.guard import Guard
from gapbridge.bridge.served.server import serve
from gapbridge.core.arrays import Array
from gapbridge.drivers.clock import Clock

AGE_BOUNDS = (0.00025, 0.0005, 0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064, 0.128)  # s
WORK_BOUNDS = (0.00005, 0.0001, 0.0002, 0.0004, 0.0008, 0.0016, 0.0032, 0.0064, 0.0128)  # s
POLL_EVERY = 0.25  # s between two readings of the shared memory
TEXT = "text/plain; version=0.0.4; charset=utf-8"
AXES = ("x", "y", "z")


class Buckets:
    """A histogram with fixed upper bounds, s."""

    def __init__(self, bounds: tuple[float, ...]) -> None:
        self.bounds = bounds
        self._counts = np.zeros(len(bounds) + 1, dtype=np.int64)
        self.sum = 0.0

    def add(self, values: Array) -> None:
        """Count values (k,), s, except NaN."""
        values = values[np.isfinite(values)]
        places = np.searchsorted(self.bounds, values)
        self._counts += np.bincount(places, minlength=len(self._counts))
        self.sum += float(values.sum())

    def cumulative(self) -> list[tuple[str, float]]:
        """Return (upper bound as text, values up to it), as Prometheus wants them."""
        names = [*(f"{bound:g}" for bound in self.bounds), "+Inf"]
        return [(n, float(c)) for n, c in zip(names, np.cumsum(self._counts), strict=True)]


class Counts:
    """Counts since this process started, and the latest values."""

    def __init__(
        self,
        memory: SharedMemory,
        settings: DaemonSettings,
        clock: Clock,
        text: str | None = None,
    ) -> None:
        self.clock = clock
        self.memory, self._slices = memory, memory.slices
        self._updated = UpdatedSettings(settings, text)  # text: the cell file's
        self.reader = memory.reader()
        self.cycles = CycleCounts(memory.slices)
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
        """Return the present settings of the run."""
        return self._updated.settings

    @property
    def state(self) -> State:
        """Return the supervisor's state; disconnected where its process has ended in another."""
        if self.status and not has_link(self.status.get("state")):
            return State.DISCONNECTED
        return State(self.memory.state)

    @property
    def silence(self) -> float:
        """Return s since the last state of the robot; infinite before the first."""
        return self.clock.monotonic() - self.received if self.received else float("inf")

    def update(self, events: list[dict[str, Any]]) -> None:
        """Process new events and cycles."""
        for event in events:
            self._on_event(event)
        rows, s = self.reader.drain(), self._slices
        if not len(rows):
            return
        self.cycles.add(rows, self.settings.link.rate)
        self.age.add(rows[:, s["age"].start])
        self.work.add(rows[:, s["duration"].start])
        self.offset = rows[-1, s["offset"]]
        self.received = float(rows[-1, s["received"].start])

    def _on_event(self, event: dict[str, Any]) -> None:
        kind = str(event.get("kind", EventKind.NOTE))
        self._updated.on_event(event)
        if kind == EventKind.STATUS:
            self.status = event
        if kind in (EventKind.STATUS, EventKind.CELL):
            return
        self.events[kind] += 1
        if kind == EventKind.RECORDER:
            self.recorder_paused = bool(event.get("paused"))
            self.recorder_lost += int(event.get("lost") or 0)
        if kind == EventKind.FAULT:
            self.faults[str(event.get("cause") or "other")[:60]] += 1
        if "to" in event:
            to, cause = str(event["to"]).lower(), str(event.get("cause", ""))
            self.transitions[to, cause] += 1
            if to == State.FAULT.name.lower():
                self.faults[cause] += 1


def run(start: StartData) -> None:
    """Serve metrics until the daemon has ended. Raises LinkError, InputError."""
    settings = start.settings.metrics
    assert settings is not None
    path = settings.token_file
    token = None if path is None else read_token(path, ("metrics", "token_file"))
    counts = Counts(start.memory, start.settings, start.clock, start.extra.get("text"))
    registry = CollectorRegistry(auto_describe=False)

    async def metrics(request: Request) -> Response:
        counts.update(start.events.poll())
        return Response(generate_latest(registry), media_type=TEXT)

    guard = Guard(Starlette(routes=[Route("/metrics", metrics)]), settings, token)
    registry.register(Families(start.session, counts, guard.refused))
    serve(
        guard, settings, "metrics", lambda: start.events.closed,
        lambda: counts.update(start.events.poll()), POLL_EVERY,
    )  # fmt: skip


class Families(Collector):
    """One scrape: all metrics of a daemon."""

    def __init__(self, session: str, counts: Counts, refused: Mapping[str, int]) -> None:
        self._session, self._counts = session, counts
        self._refused = refused  # requests, by reason

    def collect(self) -> Iterator[Metric]:
        """Give all families."""
        yield self._info()
        yield self._state()
        yield from self._cycles()
        yield from self._histograms()
        yield from self._offset()
        yield from self._reported()
        yield from self._processes()
        yield from self._recorder()
        yield _counter(
            "gapbridge_requests_refused", "Requests for metrics that were refused.",
            self._refused, "reason",
        )  # fmt: skip

    def _info(self) -> Metric:
        family = InfoMetricFamily("gapbridge_session", "The run that is counted.")
        configuration = str(self._counts.status.get("configuration_hash", ""))
        settings = self._counts.settings
        family.add_metric([], {
            "session": self._session, "cell": printable(settings.cell.stem),
            "driver": settings.link.driver, "configuration_hash": configuration,
        })  # fmt: skip
        return family

    def _state(self) -> Metric:
        family = GaugeMetricFamily(
            "gapbridge_state", "1 for the state that the supervisor is in.", labels=["state"]
        )
        present = self._counts.state
        for state in State:
            family.add_metric([state.name.lower()], float(state == present))
        return family

    def _cycles(self) -> Iterator[Metric]:
        counts, cycles, lost = self._counts, self._counts.cycles, self._counts.reader.lost
        for name, message, value in (
            ("cycles", "Cycles of the controller that were seen.", cycles.cycles),
            ("missed_cycles", "Cycles of the controller that were not seen.", cycles.missed),
            ("late_cycles", "Cycles finished later than a period after their state.", cycles.late),
            ("setpoints_written", "Setpoints sent to the robot.", cycles.written),
            ("uncounted_cycles", "Cycles overwritten before they could be counted.", lost),
        ):
            yield CounterMetricFamily(f"gapbridge_{name}", message, float(value))
        yield _counter(
            "gapbridge_setpoints_clamped", "Setpoints clamped by a limit.", cycles.clamped,
            "limit",
        )  # fmt: skip
        rate = counts.settings.link.rate
        for name, message, number in (
            ("link_rate_hertz", "Nominal cycles per second of the link.", rate),
            ("link_silence_seconds", "Time since the last state of the robot.", counts.silence),
            ("loop_heartbeat_age_seconds", "Time since the loop's last heartbeat.",
             counts.memory.silence),
        ):  # fmt: skip
            yield GaugeMetricFamily(f"gapbridge_{name}", message, number)

    def _histograms(self) -> Iterator[Metric]:
        counts = self._counts
        yield _histogram(
            "gapbridge_state_age_seconds",
            "Age of the robot's state when its cycle was done.",
            counts.age,
        )
        yield _histogram(
            "gapbridge_loop_duration_seconds", "From receiving a state to writing.", counts.work
        )

    def _offset(self) -> Iterator[Metric]:
        limits = self._counts.settings.limits
        offset = GaugeMetricFamily(
            "gapbridge_offset_meters", "TCP offset of the last cycle, in base.", labels=["axis"]
        )
        rotation = GaugeMetricFamily(
            "gapbridge_offset_rotation_radians",
            "Rotation of the TCP offset of the last cycle, in base.",
            labels=["axis"],
        )
        for i, axis in enumerate(AXES):
            offset.add_metric([axis], float(self._counts.offset[i]))
            rotation.add_metric([axis], float(self._counts.offset[3 + i]))
        yield offset
        yield rotation
        yield GaugeMetricFamily(
            "gapbridge_offset_limit_meters", "Longest offset that may be sent.", limits.offset
        )
        yield GaugeMetricFamily(
            "gapbridge_offset_rotation_limit_radians",
            "Largest rotation of an offset that may be sent.",
            limits.offset_rotation,
        )

    def _reported(self) -> Iterator[Metric]:
        counts = self._counts
        yield _counter("gapbridge_faults", "Faults, by what caused them.", counts.faults, "cause")
        yield _counter("gapbridge_events", "Events of the daemon, by kind.", counts.events, "kind")
        transitions = CounterMetricFamily(
            "gapbridge_transitions", "Changes of state.", labels=["to", "cause"]
        )
        for (to, cause), times in sorted(counts.transitions.items()):
            transitions.add_metric([to, cause], float(times))
        yield transitions
        reported = _numbers(counts.status.get("counts"))
        dropped = {
            reason.value: reported.pop(count.label)
            for reason, count in DROPPED.items()
            if count.label in reported
        }
        yield _counter("gapbridge_dropped_samples", "Implausible samples.", dropped, "reason")
        yield _counter("gapbridge_incidents", "What the loop counted, by kind.", reported, "kind")

    def _processes(self) -> Iterator[Metric]:
        status = self._counts.status
        processes = {"loop": status.get("loop"), **(status.get("sides") or {})}
        up = GaugeMetricFamily(
            "gapbridge_process_up", "1 while the process runs.", labels=["process"]
        )
        again = CounterMetricFamily(
            "gapbridge_process_restarts", "Restarts by the daemon.", labels=["process"]
        )
        for name, process in processes.items():
            if isinstance(process, Mapping):
                up.add_metric([name], float(bool(process.get("pid"))))
                again.add_metric([name], float(process.get("restarts") or 0))
        yield up
        yield again

    def _recorder(self) -> Iterator[Metric]:
        yield CounterMetricFamily(
            "gapbridge_recorder_lost_cycles",
            "Cycles that could not be recorded.",
            float(self._counts.recorder_lost),
        )
        yield GaugeMetricFamily(
            "gapbridge_recorder_paused",
            "1 while nothing can be recorded (disk full, ...).",
            float(self._counts.recorder_paused),
        )
        lag = recording_lag(self._counts.status.get("recording"), self._counts.clock.time())
        if lag is not None:
            yield GaugeMetricFamily(
                "gapbridge_recorder_lag_seconds",
                "Time since the newest file of the recording was written to.",
                lag,
            )


def _counter(name: str, message: str, values: Mapping[str, float], label: str) -> Metric:
    family = CounterMetricFamily(name, message, labels=[label])
    for key, value in sorted(values.items()):
        family.add_metric([key], float(value))
    return family


def _histogram(name: str, message: str, buckets: Buckets) -> Metric:
    family = HistogramMetricFamily(name, message)
    family.add_metric([], buckets.cumulative(), buckets.sum)
    return family


def _numbers(part: Any) -> dict[str, float]:
    """Return the finite numbers of a part of a document."""
    if not isinstance(part, Mapping):
        return {}
    return {
        str(key): float(value)
        for key, value in part.items()
        if isinstance(value, int | float) and math.isfinite(value)
    }


def recording_lag(recording: Any, now: float) -> float | None:
    """Return s until ``now`` (s since 1970) since the newest file of a recording changed.

    ``recording``: its folder and run. None without any file of it.
    """
    if not recording:
        return None
    stem = Path(str(recording))
    try:
        newest = max(p.stat().st_mtime for p in segments(stem.parent, stem.name))
    except (OSError, ValueError):
        return None
    return max(now - newest, 0.0)


if __name__ == "__main__":
    sys.exit(run_side("metrics", run))
