"""What must hold for every write on the wire, checked by code of its own.

Offsets come from the wire as they are, or by the forward kinematics of the simulated plant from the
joints that were written. Nothing of core/limits.py is used: the numbers are those of the cell file.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from benchmarks.faults.wire.seen import Fresh, Numbers, Write
from gapbridge.drivers.simulated.plant.kinematics import gap, tcp_in_base
from gapbridge.drivers.simulated.plant.plant_arm import Frame, PlantArm

OBSERVING, ARMED = 1, 2
WRITING = (3, 4)  # compensating, holding
GRACE = 0.03  # s: a write seen so long after the state has changed was on its way
SURE = 0.002  # s: the same where the loop's own word says when it changed
GAP = 5.0  # cycles: a longer gap allows no larger step
WINDOW = 12  # writes over which the rate is checked
ZEROS = (0.0,) * 6
RATE_KEPT = 0.98  # of the cell's rate: the robot's program has it rounded down
STAYED = 0.005  # rad: a stream that begins so near to the last one's end goes on from there
START_AWAY = 0.03  # rad: how far a stream may begin from where the arm was seen
AHEAD = 4  # states that the client may have been sent and not read yet, on top of ``fresh``
LONGEST_LIST = 50


@dataclass(frozen=True)
class Bounds:
    """What a cell allows: m, rad, m/s, rad/s, s.

    ``grain`` is what the wire's rounding can add to an offset, ``fresh`` how old a state may be
    behind a write, ``lag`` how far a client may be behind what it was sent.
    """

    arm: PlantArm
    tool: Frame
    offset: float
    rotation: float
    offset_rate: float
    rotation_rate: float
    cycle: float
    grain: float = 1e-8
    grain_rotation: float = 1e-8
    fresh: float = 0.04
    burst: float = 0.0  # s for which the transport may hold small packets back
    lag: float = 0.04
    withdraws: float = (
        math.inf
    )  # s of silence after which the robot's own program withdraws offsets


@dataclass
class Found:
    """What a check has seen so far."""

    writes: int = 0
    frames: int = 0  # of any kind that the client wrote
    largest_offset: float = 0.0  # m
    largest_step: float = 0.0  # m, between two writes that follow each other
    largest_turn: float = 0.0  # rad
    oldest_state: float = 0.0  # s, behind a write
    violations: list[str] = field(default_factory=list)
    violated: int = 0
    recent: deque[Fresh | Write] = field(default_factory=lambda: deque(maxlen=10))

    def add(self, message: str) -> None:
        """Note a violation, the first few with what went over the wire just before."""
        self.violated += 1
        if len(self.violations) < LONGEST_LIST:
            before = "; ".join(map(_brief, self.recent)) if self.violated < 5 else ""
            self.violations.append(f"{message} [{before}]" if before else message)


@dataclass
class Stream:
    """What is known of a stream of setpoints between its begin and its end."""

    offset: Numbers = ZEROS
    nominal: Frame | None = None  # where a stream of joints began
    joints: tuple[Numbers, Numbers] = ((), ZEROS)  # the last ones, and their offset
    recent: deque[tuple[float, Numbers]] = field(default_factory=lambda: deque(maxlen=WINDOW))


@dataclass(frozen=True)
class Suspected:
    """A write that was seen in a state that forbids it; the loop's word will say more."""

    earliest: float
    time: float
    state: int
    values: Numbers = ()


class Checker:
    """Follows one link's states and writes in the order of the wire."""

    def __init__(self, bounds: Bounds) -> None:
        self.bounds = bounds
        self.found = Found()
        self.suspected: list[Suspected] = []
        self._fresh: Fresh | None = None
        self._unsafe_since: float | None = None
        self._last_writing = -math.inf  # s: when the supervisor was last in a state that writes
        self._stream, self._ended = Stream(), Stream()
        self._ended_at = -math.inf  # s
        self._written, self._written_at = ZEROS, -math.inf  # the last offset on the wire; s
        self._unused = 0.0  # states that no write has followed yet
        self._planned: tuple[int, float] | None = None  # the joint that the plan moves; rad before

    def leave_to_plan(self, joint: int) -> None:
        """Take what ``joint`` (from 0) does from now on for the plan's; offsets are the others'."""
        q = self._stream.joints[0] or (self._fresh.q if self._fresh is not None else ())
        self._planned = (joint, q[joint])

    @property
    def last_offset(self) -> Numbers:
        """Return the offset (6,) that the last write carried; what is over has none."""
        return self._stream.offset

    def take(self, seen: Sequence[Fresh | Write]) -> None:
        """Check what the tap has seen next."""
        for item in seen:
            self.found.recent.append(item)
            if item.state in WRITING:
                self._last_writing = max(self._last_writing, item.time)
            elif item.early - self._last_writing > GRACE:
                self._end_stream(item.early)
            if isinstance(item, Fresh):
                self._learn(item)
            else:
                self._check(item)

    def settle(self, spans: Sequence[tuple[float, float]]) -> None:
        """Judge what is suspected by when the loop was writing, s monotonic."""
        suspected, self.suspected = self.suspected, []
        for write in suspected:
            if not any(a - SURE <= write.time and write.earliest <= b + SURE for a, b in spans):
                late = min((write.earliest - b for _, b in spans if b < write.time), default=0.0)
                values = [round(v, 6) for v in write.values]
                self.found.add(
                    f"write in state {write.state}, {late:.3f} s after the last allowed: {values}"
                )

    def _end_stream(self, time: float) -> None:
        """Nothing is being written: the next stream begins without an offset, wherever it is."""
        if self._stream.recent or self._stream.nominal is not None:
            self._ended, self._ended_at, self._stream = self._stream, time, Stream()

    def _learn(self, fresh: Fresh) -> None:
        self._fresh = fresh
        b = self.bounds
        self._unused = min(self._unused + 1.0, AHEAD + (b.lag + b.burst) / b.cycle)
        if fresh.safe or not fresh.safe_known:
            self._unsafe_since = None
        elif self._unsafe_since is None:
            self._unsafe_since = fresh.time

    def _check(self, write: Write) -> None:
        found, b = self.found, self.bounds
        found.frames += 1
        if write.kind in ("broken", "forbidden"):
            found.add(f"{write.kind} write: {write.where}")
        if write.kind not in ("offset", "joints"):
            return
        if not all(math.isfinite(v) and abs(v) < 1e3 for v in write.values):
            found.add(f"{write.where}: {write.values}")
            return
        if write.kind == "offset" and write.state not in WRITING and self._announces(write):
            self._written, self._written_at = write.values, write.time
            return
        if write.kind == "joints" and write.state not in WRITING and self._holds(write):
            return
        found.writes += 1
        if write.time < self._ended_at and not self._stream.recent:
            self._stream, self._ended_at = self._ended, -math.inf  # it was only seen late
        self._check_state(write)
        self._check_fresh(write)
        offset = self._offset_of(write)
        self._check_size(write, offset)
        self._check_step(write, offset)
        if write.kind == "joints":
            for i, (q, low, high) in enumerate(
                zip(write.values, b.arm.lower, b.arm.upper, strict=True), 1
            ):
                if not low - 1e-4 <= q <= high + 1e-4:
                    found.add(f"joint {i}: {q:.4f} rad is outside its limits")

    def _announces(self, write: Write) -> bool:
        """Return whether an offset of zero says that one will come: none is in force before it.

        That is part of arming, which may have been refused by the time that the tap sees it.
        """
        b, left = self.bounds, self._in_force(write.time)
        seen = self._fresh  # after a stop, or another's zero, the program has none before its time
        if seen is not None and seen.bare and seen.time - self._written_at > b.fresh:
            left = ZEROS
        bare = math.hypot(*left[:3]) <= b.offset_rate * b.cycle + 2.0 * b.grain
        bare = bare and math.hypot(*left[3:]) <= b.rotation_rate * b.cycle + 2.0 * b.grain_rotation
        return bare and not any(write.values) and write.state in (OBSERVING, ARMED)

    def _in_force(self, time: float) -> Numbers:
        """Return the offset (6,) that the wire's last one has come to, the robot's program at it.

        It stays until the robot's program has been silent for long enough, and goes at the rates
        of the cell: whoever writes next goes on from there.
        """
        b = self.bounds
        if not any(self._written) or math.isinf(b.withdraws):
            return self._written
        silent = max(time - self._written_at - b.withdraws, 0.0)
        offset = self._written
        parts: list[float] = []
        for first, rate in ((0, b.offset_rate), (3, b.rotation_rate)):
            vector = offset[first : first + 3]
            length = math.hypot(*vector)
            # a program's rate is rounded down, and its silence counted in its own cycles
            left = max(length - RATE_KEPT * rate * silent, 0.0)
            parts += [v * left / length if left else 0.0 for v in vector]
        return tuple(parts)

    def _holds(self, write: Write) -> bool:
        """Return whether joints are those where the arm stands: it is being enabled or left."""
        if self._fresh is None:
            return False
        away = max(abs(a - b) for a, b in zip(write.values, self._fresh.q, strict=True))
        return away < START_AWAY and write.state == 2

    def _check_state(self, write: Write) -> None:
        if write.state not in WRITING:
            self.suspected.append(Suspected(write.early, write.time, write.state, write.values))
        since, b = self._unsafe_since, self.bounds
        if since is not None and write.early - since > max(b.fresh, GRACE + b.cycle):
            self.found.add(
                f"write {write.early - since:.3f} s after the robot said it must not move"
            )

    def _check_fresh(self, write: Write) -> None:
        if self._fresh is None:
            self.found.add("write before any state")
            return
        age = write.early - self._fresh.time
        self._unused -= 1.0
        self.found.oldest_state = max(self.found.oldest_state, age)
        if age > self.bounds.fresh:
            reported = f"write {age:.3f} s after the last fresh state"
            self.found.add(f"{reported}, {[round(v, 6) for v in write.values]}")
        elif self._unused < 0.0:
            self._unused = 0.0
            self.found.add("more writes than states")

    def _offset_of(self, write: Write) -> Numbers:
        """Return the TCP offset (6,) of a write, base axes, m and rad."""
        if write.kind == "offset":
            return write.values
        stream = self._stream
        if stream.nominal is None:
            stream.nominal = self._nominal_of(write.values)
            stream.offset = gap(stream.nominal, self._tcp_in_base(write.values))
            if self._fresh is not None:
                away = max(abs(x - y) for x, y in zip(write.values, self._fresh.q, strict=True))
                if away > START_AWAY:
                    self.found.add(f"a stream began {away:.4f} rad from where the arm was")
        if stream.joints[0] != write.values or stream.joints[1] is ZEROS:
            stream.joints = (write.values, gap(stream.nominal, self._tcp_in_base(write.values)))
        return stream.joints[1]

    def _tcp_in_base(self, q: Numbers) -> Frame:
        """Return where joints (n,) rad bring the TCP, without what the plan itself moves."""
        if self._planned is not None:
            joint, before = self._planned
            q = (*q[:joint], before, *q[joint + 1 :])
        return tcp_in_base(self.bounds.arm, q, self.bounds.tool)

    def _nominal_of(self, q: Numbers) -> Frame:
        """Return where the TCP was wanted as a stream of joints begins.

        Where the last one has left the arm, its offset is still in it: what was wanted is older.
        """
        last = self._ended
        if last.nominal is not None and len(last.joints[0]) == len(q):
            away = max(abs(x - y) for x, y in zip(q, last.joints[0], strict=True))
            if away < STAYED:
                return last.nominal
        return self._tcp_in_base(q)

    def _check_size(self, write: Write, offset: Numbers) -> None:
        b = self.bounds
        length, turn = math.hypot(*offset[:3]), math.hypot(*offset[3:])
        self.found.largest_offset = max(self.found.largest_offset, length)
        if length > b.offset * 1.001 + b.grain:
            self.found.add(f"offset of {1e3 * length:.4f} mm, allowed {1e3 * b.offset:g}")
        if turn > b.rotation * 1.001 + b.grain_rotation:
            self.found.add(f"offset of {turn:.6f} rad, allowed {b.rotation:g}")

    def _check_step(self, write: Write, offset: Numbers) -> None:
        b, found, stream = self.bounds, self.found, self._stream
        before = self._in_force(write.early) if write.kind == "offset" else stream.offset
        shift, turn = _apart(offset, before)
        found.largest_step = max(found.largest_step, shift)
        found.largest_turn = max(found.largest_turn, turn)
        if shift > b.offset_rate * GAP * b.cycle * 1.001 + 2.0 * b.grain:
            found.add(f"step of {1e3 * shift:.4f} mm at once")
        if turn > b.rotation_rate * GAP * b.cycle * 1.001 + 2.0 * b.grain_rotation:
            found.add(f"step of {turn:.6f} rad at once")
        since, until = self._moments(write)
        place, angle = offset[:3], offset[3:]
        for then, before in stream.recent:
            allowed = max(until - then, 0.0) + b.lag + b.burst  # the clock may be set back
            shift, turn = math.dist(place, before[:3]), math.dist(angle, before[3:])
            if shift > b.offset_rate * allowed * 1.001 + 2.0 * b.grain:
                found.add(f"{1e3 * shift:.4f} mm within {1e3 * (until - then):.1f} ms")
                break
            if turn > b.rotation_rate * allowed * 1.001 + 2.0 * b.grain_rotation:
                found.add(f"{turn:.6f} rad within {1e3 * (until - then):.1f} ms")
                break
        stream.recent.append((since, offset))
        stream.offset = offset
        if write.kind == "offset":
            self._written, self._written_at = offset, write.time

    def _moments(self, write: Write) -> tuple[float, float]:
        """Return from when and until when the time of a write's state can be, s.

        Rates hold over the time of the states that setpoints are made of: the controller's where
        the wire has it, else the time between the state's arrival and the write.
        """
        fresh = self._fresh
        if fresh is None:
            return write.early, write.time
        if math.isfinite(fresh.stamp):
            return fresh.stamp, fresh.stamp
        return fresh.early, write.time


def _brief(item: Fresh | Write) -> str:
    what = "state" if isinstance(item, Fresh) else item.kind
    return f"{item.time:.3f} {what} in {item.state}"


def _apart(a: Numbers, b: Numbers) -> tuple[float, float]:
    """Return how far two offsets are apart, m and rad."""
    return math.dist(a[:3], b[:3]), math.dist(a[3:], b[3:])
