"""Where a session stands: what its journal holds, entry by entry; how far it has come."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from statistics import median
from typing import Any

import numpy as np

from gapbridge.bridge.calibration.format import duration
from gapbridge.bridge.calibration.session.journal import Entry, Journal
from gapbridge.bridge.calibration.session.plan_document import entry_of, plan_of
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import Plan, PlannedPose
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.loads import Loads

_VECTORS = ("q", "value", "approach", "temperature", "wrench", "raw_wrench")
FIRST = 60.0  # s a stop, before anyone knows
PAUSE = 600.0  # s: a longer time between two readings was a pause
WIDTH = 16  # characters of the whole bar


@dataclass(frozen=True)
class Reading:
    """What was measured at one stop."""

    stop: int  # number in the plan's poses, from 0
    q: Array  # (n,) rad
    value: Array  # (k,) SI, mean of the samples
    scatter: float  # m, 1 sigma of one coordinate of the mean; nan: not known
    samples: int  # averaged
    load: int
    station: int
    target: int
    approach: Array  # (n,) sign of each joint's last motion
    time: float = 0.0  # s, time.time()
    source: str = ""  # row or file of the instrument
    temperature: Array | None = None  # (n,) °C
    wrench: Array | None = None  # (6,) N, Nm: actual_TCP_force
    raw_wrench: Array | None = None  # (6,) N, Nm: ft_raw_wrench
    again: bool = False  # an earlier stop, measured once more
    doubted: bool = False  # kept by the person though it did not fit

    def entry(self) -> dict[str, Any]:
        """Return it for the journal, which gives it its time."""
        return {k: v for k, v in asdict(self).items() if v is not None and k != "time"}

    @classmethod
    def of(cls, entry: dict[str, Any]) -> Reading:
        """Return what an entry of the journal holds."""
        known = {k: v for k, v in entry.items() if k in cls.__dataclass_fields__}
        for name in _VECTORS:
            if name in known:
                known[name] = np.array([float(v) for v in known[name]])
        known["scatter"] = float(known["scatter"])
        return cls(**known)


@dataclass
class Session:
    """A session in memory; everything that changes it goes through its journal first."""

    journal: Journal
    begun: Entry = field(default_factory=dict)  # the first entry
    plan: Plan | None = None
    taken: list[Reading] = field(default_factory=list)
    undone: int = 0
    skipped: set[int] = field(default_factory=set)
    mounted: int | None = None  # load that hangs on the flange
    station: int = 0
    place: int = 0  # of the plan's, at which the instrument stands
    target: int = 0
    notes: list[str] = field(default_factory=list)
    used: set[str] = field(default_factory=set)
    seconds: list[float] = field(default_factory=list)  # between a reading and the one before

    @classmethod
    def of(cls, journal: Journal) -> Session:
        """Return where the session of an open journal stands."""
        session = cls(journal)
        for entry in journal.entries:
            session.apply(entry)
        return session

    def add(self, kind: str, **fields: Any) -> None:
        """Write an entry, then act on it."""
        self.apply(self.journal.add(kind, **fields))

    def apply(self, entry: Entry) -> None:
        """Act on an entry of the journal; one of a kind that is not known means nothing here."""
        match entry["kind"]:
            case "begun":
                self.begun = entry
            case "plan":
                self.plan = plan_of(entry["plan"])
            case "reading":
                self._take(Reading.of(entry))
            case "rejected":
                self.used.add(entry.get("source", ""))
            case "undo":
                self.undone += 1
                self.taken.pop()
            case "skip":
                self.skipped.add(int(entry["stop"]))
            case "mounted":
                self.mounted = int(entry["load"])
            case "moved":
                self._move(entry)
            case "note":
                self.notes.append(str(entry["text"]))

    def _take(self, found: Reading) -> None:
        if self.taken and found.time - self.taken[-1].time > 0.0:
            self.seconds.append(found.time - self.taken[-1].time)
        self.taken.append(found)
        self.used.add(found.source)

    def _move(self, entry: Entry) -> None:
        self.station = int(entry["station"])
        self.target = int(entry["target"])
        self.place = int(entry.get("place", self.place))
        since = entry.get("since")  # readings from this one on were of the new place already
        if since is not None:
            for i in range(int(since), len(self.taken)):
                self.taken[i] = replace(self.taken[i], station=self.station, target=self.target)

    # -- what follows -----------------------------------------------------------------------------

    @property
    def stops(self) -> tuple[PlannedPose, ...]:
        """Return the planned stops in the order of travel."""
        return () if self.plan is None else self.plan.poses

    @property
    def next(self) -> int | None:
        """Return the number of the next stop, None after the last."""
        done = {t.stop for t in self.taken} | self.skipped
        return next((i for i in range(len(self.stops)) if i not in done), None)

    @property
    def left(self) -> int:
        """Return how many stops are left."""
        done = {t.stop for t in self.taken} | self.skipped
        return sum(i not in done for i in range(len(self.stops)))

    @property
    def places(self) -> int:
        """Return how many places the instrument has had; 1 means that it was never moved."""
        return max((t.station for t in self.taken), default=0) + 1

    def all_readings(self, kind: str) -> Readings:
        """Return all readings, the instrument's places numbered without holes."""
        found = self.readings(kind)
        return replace(found, station=np.unique(found.station, return_inverse=True)[1])

    def readings(self, kind: str, taken: list[Reading] | None = None) -> Readings:
        """Return readings (default: all that stand) as the calibration takes them."""
        assert self.plan is not None
        rows = self.taken if taken is None else taken
        loads, stops = self.plan.loads, self.stops
        n = len(stops[0].q) if stops else 0
        temperature = [t.temperature for t in rows]
        return Readings(
            kind=kind,
            q=np.array([t.q for t in rows]).reshape(-1, n),
            value=np.array([t.value for t in rows]).reshape(len(rows), -1 if rows else 3),
            scatter=np.array([t.scatter for t in rows]),
            loads=Loads(
                payload_mass=np.array([loads[t.load].mass for t in rows]),
                payload_cog=np.array([loads[t.load].cog for t in rows]).reshape(-1, 3),
                temperature=(
                    None if any(v is None for v in temperature) or not rows
                    else np.array(temperature, dtype=float)
                ),
                approach=np.array([t.approach for t in rows]).reshape(-1, n),
            ),
            load=np.array([t.load for t in rows], dtype=np.int64),
            station=np.array([t.station for t in rows], dtype=np.int64),
            target=np.array([t.target for t in rows], dtype=np.int64),
            held_out=np.array([stops[t.stop].held_out for t in rows], dtype=bool),
            pose=np.array([stops[t.stop].number for t in rows], dtype=np.int64),
        )  # fmt: skip

    def keep_plan(self, plan: Plan) -> None:
        """Write the plan that the session follows."""
        self.add("plan", plan=entry_of(plan))


def seconds_left(session: Session, minutes_per_load: float) -> float:
    """Return s until the last stop, by the readings so far."""
    paces = [s for s in session.seconds if s < PAUSE][-20:]
    done = {t.stop for t in session.taken} | session.skipped
    blocks = {(p.station, p.load) for i, p in enumerate(session.stops) if i not in done}
    changes = len(blocks - {(session.place, session.mounted)})
    return session.left * (median(paces) if paces else FIRST) + changes * 60.0 * minutes_per_load


def header(session: Session, stop: int, minutes_per_load: float) -> str:
    """Return the line above a stop."""
    count, done = len(session.stops), len(session.stops) - session.left
    pose = session.stops[stop]
    drawn = "█" * round(done / count * WIDTH)
    more = [f"place {pose.station + 1}"] if any(p.station for p in session.stops) else []
    if pose.repeat:
        first = next(i for i, p in enumerate(session.stops) if p.number == pose.number)
        more.append(f"stop {first + 1} once more")
    if pose.held_out:
        more.append("to verify, not fitted")
    return " · ".join(
        [f"{drawn:░<{WIDTH}} stop {stop + 1} of {count}", f"load {pose.load + 1}", *more,
         f"{duration(seconds_left(session, minutes_per_load))} left"]
    )  # fmt: skip
