"""State of a session, replayed from its journal: its plan, readings and progress."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from gapbridge.bridge.calibration.format import duration
from gapbridge.bridge.calibration.session.journal import Entry, Journal
from gapbridge.bridge.document.output_file import write_table
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import Expectation, Payload, Plan, PlannedPose
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.errors import InputError
from gapbridge.core.loads import Loads
from gapbridge.core.notes import Note, Reason

_VECTORS = ("q", "value", "approach", "temperature", "wrench", "raw_wrench")
DEFAULT_INTERVAL = 60.0  # s per stop, before the first two readings
MAX_INTERVAL = 600.0  # s; a longer time between two readings is a pause
BAR_WIDTH = 16  # characters of the progress bar


@dataclass(frozen=True)
class Reading:
    """One averaged reading at a stop; field names are keys of the journal."""

    stop: int  # index in Plan.poses
    q: Array  # (n,) rad
    value: Array  # (k,) SI, mean of the samples
    scatter: float  # m, 1 sigma of one coordinate of the mean; nan: not known
    samples: int  # number averaged
    load: int  # index in Plan.loads
    station: int  # position of the instrument, from 0: each has a frame of its own
    target: int  # position of the target on the tool, from 0
    approach: Array  # (n,) sign of each joint's last motion
    time: float = 0.0  # s, time.time()
    source: str = ""  # row or file that it was read from
    temperature: Array | None = None  # (n,) °C
    wrench: Array | None = None  # (6,) N, Nm: actual_TCP_force
    raw_wrench: Array | None = None  # (6,) N, Nm: ft_raw_wrench
    again: bool = False  # an earlier stop, measured again
    doubted: bool = False  # kept by the operator although implausible

    def entry(self) -> dict[str, Any]:
        """Return the journal entry, without the time, which the journal adds."""
        return {k: v for k, v in asdict(self).items() if v is not None and k != "time"}

    @classmethod
    def of(cls, entry: dict[str, Any]) -> Reading:
        """Return the reading of a journal entry."""
        known = {k: v for k, v in entry.items() if k in cls.__dataclass_fields__}
        for name in _VECTORS:
            if name in known:
                known[name] = _array(known[name])
        known["scatter"] = float(known["scatter"])
        return cls(**known)


@dataclass
class Session:
    """State of a session; every change is written to the journal first."""

    journal: Journal
    start_entry: Entry = field(default_factory=dict)  # the last of kind "begun"; empty: none
    plan: Plan | None = None
    accepted: list[Reading] = field(default_factory=list)
    undone: int = 0  # number of readings discarded with `undo`
    skipped: dict[int, int] = field(default_factory=dict)  # stop -> count of readings before
    mounted: int | None = None  # index in Plan.loads of the load on the flange
    station: int = 0  # of the instrument, as in Reading: also counts unplanned moves
    place: int = 0  # planned position of the instrument, as PlannedPose.station
    target: int = 0  # added to PlannedPose.target: counts slips of the target
    has_ended: bool = False  # its readings were evaluated
    notes: list[str] = field(default_factory=list)
    used_sources: set[str] = field(default_factory=set)
    intervals: list[float] = field(default_factory=list)  # s between consecutive readings

    @classmethod
    def of(cls, journal: Journal) -> Session:
        """Return the session of an open journal. Raises InputError if it was changed by hand."""
        session = cls(journal)
        for row, entry in enumerate(journal.entries, 1):
            try:
                if entry["kind"] == "reading" and entry in journal.entries[: row - 1]:
                    raise ValueError("the same reading twice")
                session.apply(entry)
            except (LookupError, TypeError, ValueError):
                raise InputError(
                    f"{journal.path}: row {row}: found an entry {entry['kind']!r} that does not "
                    "fit those before it, expected the journal as the session wrote it"
                ) from None
        return session

    @property
    def has_begun(self) -> bool:
        """Return whether it has a plan or readings; a start that was refused left none."""
        return self.plan is not None or bool(self.used_sources) or bool(self.accepted)

    def add(self, kind: str, **fields: Any) -> None:
        """Write an entry to the journal, then apply it."""
        self.apply(self.journal.add(kind, **fields))

    def undo(self) -> str:
        """Discard the last reading, or the skip after it; returns what was done as text."""
        skips = [stop for stop, before in self.skipped.items() if before >= len(self.accepted)]
        if skips:
            stop, done = skips[-1], "to be measured after all: stop"
        elif self.accepted:
            stop, done = self.accepted[-1].stop, "discarded the reading of stop"
        else:
            return "no reading to discard"
        self.add("undo", stop=stop)
        return f"{done} {stop + 1}"

    def apply(self, entry: Entry) -> None:
        """Apply an entry of the journal; unknown kinds are ignored."""
        match entry["kind"]:
            case "begun":
                self.start_entry = {**entry, "time": float(entry["time"])}
            case "plan":
                self.plan = plan_of(entry["plan"])
            case "reading":
                self._accept(Reading.of(entry))
                self.has_ended = False
            case "ended":
                self.has_ended = True
            case "rejected":
                self.used_sources |= {entry.get("source", ""), *entry.get("sources", ())}
            case "undo" if entry.get("stop") in self.skipped:
                del self.skipped[entry["stop"]]
                self.has_ended = False
            case "undo":
                self.undone += 1
                self.has_ended = False
                self.accepted.pop()
            case "skip":
                self.skipped[int(entry["stop"])] = len(self.accepted)
            case "mounted":
                self.mounted = int(entry["load"])
            case "moved":
                self._move_instrument(entry)
            case "note":
                self.notes.append(str(entry["text"]))

    def _accept(self, reading: Reading) -> None:
        if self.plan is None:
            raise ValueError("a reading before the plan")
        pose, _ = self.plan.poses[reading.stop], self.plan.loads[reading.load]
        if reading.q.shape != pose.q.shape or not np.isfinite(reading.q).all():
            raise ValueError("joints of another arm")
        if any(reading.value.shape != other.value.shape for other in self.accepted[-1:]):
            raise ValueError("a reading of another kind")
        if self.accepted and reading.time - self.accepted[-1].time > 0.0:
            self.intervals.append(reading.time - self.accepted[-1].time)
        self.accepted.append(reading)
        self.used_sources.add(reading.source)

    def _move_instrument(self, entry: Entry) -> None:
        self.station = int(entry["station"])
        self.target = int(entry["target"])
        self.place = int(entry.get("place", self.place))
        since = entry.get("since")  # index of the first reading taken after the move
        if since is not None:
            for i in range(int(since), len(self.accepted)):
                self.accepted[i] = replace(
                    self.accepted[i], station=self.station, target=self.target
                )

    @property
    def stops(self) -> tuple[PlannedPose, ...]:
        """Return the planned stops in the order of travel."""
        return () if self.plan is None else self.plan.poses

    @property
    def open_stops(self) -> list[int]:
        """Return the stops that are neither measured nor skipped."""
        done = {r.stop for r in self.accepted}.union(self.skipped)
        return [i for i in range(len(self.stops)) if i not in done]

    @property
    def next_stop(self) -> int | None:
        """Return the first open stop, None after the last."""
        return next(iter(self.open_stops), None)

    @property
    def remaining(self) -> int:
        """Return the number of open stops."""
        return len(self.open_stops)

    @property
    def station_count(self) -> int:
        """Return the number of positions of the instrument; 1: it was never moved."""
        return max((r.station for r in self.accepted), default=0) + 1

    def all_readings(self, kind: str) -> Readings:
        """Return all accepted readings, stations numbered consecutively."""
        readings = self.readings(kind)
        return replace(readings, station=np.unique(readings.station, return_inverse=True)[1])

    def readings(self, kind: str, selected: list[Reading] | None = None) -> Readings:
        """Return readings (default: all accepted ones) as input of the fit."""
        assert self.plan is not None
        rows = self.accepted if selected is None else selected
        loads, stops = self.plan.loads, self.stops
        n = len(stops[0].q) if stops else 0
        temperature = [r.temperature for r in rows]
        return Readings(
            kind=kind,
            q=np.array([r.q for r in rows]).reshape(-1, n),
            value=np.array([r.value for r in rows]).reshape(len(rows), -1 if rows else 3),
            scatter=np.array([r.scatter for r in rows]),
            loads=Loads(
                payload_mass=np.array([loads[r.load].mass for r in rows]),
                payload_cog=np.array([loads[r.load].cog for r in rows]).reshape(-1, 3),
                temperature=(
                    None if any(v is None for v in temperature) or not rows
                    else np.array(temperature, dtype=float)
                ),
                approach=np.array([r.approach for r in rows]).reshape(-1, n),
            ),
            load=np.array([r.load for r in rows], dtype=np.int64),
            station=np.array([r.station for r in rows], dtype=np.int64),
            target=np.array([r.target for r in rows], dtype=np.int64),
            held_out=np.array([stops[r.stop].held_out for r in rows], dtype=bool),
            pose=np.array([stops[r.stop].number for r in rows], dtype=np.int64),
        )  # fmt: skip

    def add_plan(self, plan: Plan) -> None:
        """Write the plan to the journal."""
        self.add("plan", plan=entry_of(plan))


def seconds_left(session: Session, minutes_per_load: float) -> float:
    """Return the estimated time to the last stop, s, from the intervals so far."""
    recent = [s for s in session.intervals if s < MAX_INTERVAL][-20:]
    per_stop = median(recent) if recent else DEFAULT_INTERVAL
    setups = {(session.stops[i].station, session.stops[i].load) for i in session.open_stops}
    changes = len(setups - {(session.place, session.mounted)})
    return session.remaining * per_stop + changes * 60.0 * minutes_per_load


def stop_header(session: Session, stop: int, minutes_per_load: float) -> str:
    """Return the progress line shown before a stop."""
    count, done = len(session.stops), len(session.stops) - session.remaining
    pose = session.stops[stop]
    bar = "█" * round(done / count * BAR_WIDTH)
    details = [f"place {pose.station + 1}"] if any(p.station for p in session.stops) else []
    if pose.repeat:
        first = next(i for i, p in enumerate(session.stops) if p.number == pose.number)
        details.append(f"stop {first + 1} once more")
    if pose.held_out:
        details.append("to verify, not fitted")
    return " · ".join(
        [f"{bar:░<{BAR_WIDTH}} stop {stop + 1} of {count}", f"load {pose.load + 1}", *details,
         f"{duration(seconds_left(session, minutes_per_load))} left"]
    )  # fmt: skip


def plan_of(entry: dict[str, Any]) -> Plan:
    """Return the plan of a journal entry."""
    expected = entry["expected"]
    return Plan(
        loads=tuple(
            Payload(float(p["mass"]), _vector3(p["cog"]), str(p["name"])) for p in entry["loads"]
        ),
        poses=tuple(_pose(p) for p in entry["poses"]),
        expected=Expectation(
            names=tuple(expected["names"]), units=tuple(expected["units"]),
            std=_array(expected["std"]), prior=_array(expected["prior"]),
            tcp_std=float(expected["tcp_std"]), tcp_std_worst=float(expected["tcp_std_worst"]),
        ),
        bought=tuple((int(n), float(s)) for n, s in entry["bought"]),
        travel=float(entry["travel"]),
        notes=tuple(Note(Reason[name], tuple(values)) for name, values in entry["notes"]),
    )  # fmt: skip


def entry_of(plan: Plan) -> dict[str, Any]:
    """Return the journal entry of a plan."""
    return {**asdict(plan), "notes": [(note.reason.name, note.values) for note in plan.notes]}


def _pose(entry: dict[str, Any]) -> PlannedPose:
    return PlannedPose(**{**entry, "q": _array(entry["q"]), "approach": _array(entry["approach"])})


def _array(values: list[Any]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.array([float(v) for v in values])


def _vector3(values: list[Any]) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def write_poses(plan: Plan, path: Path) -> None:
    """Write the stops as CSV in the order of travel: stop (from 1), place, load, joints in rad."""
    n = len(plan.poses[0].q)
    rows = [
        (i + 1, p.number, p.station, p.load, plan.loads[p.load].mass, p.held_out, p.repeat, *p.q)
        for i, p in enumerate(plan.poses)
    ]
    names = ["stop", "pose", "place", "load", "payload", "held_out", "repeat"]
    write_table(path, [*names, *(f"target_q_{i}" for i in range(n))], np.array(rows, dtype=float))
