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
from drivers.simulated.kinematics import gap, tcp_in_base
from drivers.simulated.plant_arm import Frame, PlantArm

WRITING = (3, 4)  # compensating, holding
GRACE = 0.03  # s: a write seen so long after the state has changed was on its way
GAP = 5.0  # cycles: a longer gap allows no larger step
WINDOW = 12  # writes over which the rate is checked
ZEROS = (0.0,) * 6
START_AWAY = 0.03  # rad: how far a stream may begin from where the arm was seen
AHEAD = 4  # writes that may follow one state: samples that the client had not read yet
LONGEST_LIST = 50


@dataclass(frozen=True)
class Bounds:
    """What a cell allows: m, rad, m/s, rad/s, s.

    ``grain`` is what the wire's rounding can add to an offset, ``fresh`` how old a state may be
    behind a write.
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
    recent: deque[str] = field(default_factory=lambda: deque(maxlen=10))

    def add(self, words: str) -> None:
        """Note a violation, the first few with what went over the wire just before."""
        self.violated += 1
        if len(self.violations) < LONGEST_LIST:
            before = "; ".join(self.recent) if self.violated < 5 else ""
            self.violations.append(f"{words} [{before}]" if before else words)


class Checker:
    """Follows one link's states and writes in the order of the wire."""

    def __init__(self, bounds: Bounds) -> None:
        self.bounds = bounds
        self.found = Found()
        self._fresh: Fresh | None = None
        self._unsafe_since: float | None = None
        self._last_writing = -math.inf  # s: when the supervisor was last in a state that writes
        self._nominal: Frame | None = None  # where the stream of joints began
        self._offset: Numbers = ZEROS
        self._recent: deque[tuple[float, Numbers]] = deque(maxlen=WINDOW)
        self._since_fresh = 0
        self._joints: tuple[Numbers, Numbers] = ((), ZEROS)

    def take(self, seen: Sequence[Fresh | Write]) -> None:
        """Check what the tap has seen next."""
        for item in seen:
            what = "state" if isinstance(item, Fresh) else item.kind
            self.found.recent.append(f"{item.time:.3f} {what} in {item.state}")
            if item.state in WRITING:
                self._last_writing = item.time
            elif item.time - self._last_writing > GRACE:
                self._end_stream()
            if isinstance(item, Fresh):
                self._learn(item)
            else:
                self._check(item)

    def _end_stream(self) -> None:
        """Nothing is being written: the next stream begins without an offset, wherever it is."""
        if self._recent or self._nominal is not None:
            self._offset, self._nominal, self._joints = ZEROS, None, ((), ZEROS)
            self._recent.clear()

    def _learn(self, fresh: Fresh) -> None:
        self._fresh = fresh
        self._since_fresh = 0
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
        if write.kind == "offset" and not any(write.values) and write.state not in WRITING:
            return  # an offset of zero takes out what may be there; it may always leave
        if write.kind == "joints" and write.state not in WRITING and self._holds(write):
            return
        found.writes += 1
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

    def _holds(self, write: Write) -> bool:
        """Return whether joints are those where the arm stands: it is being enabled or left."""
        if self._fresh is None:
            return False
        away = max(abs(a - b) for a, b in zip(write.values, self._fresh.q, strict=True))
        return away < START_AWAY and write.state == 2

    def _check_state(self, write: Write) -> None:
        late = write.time - self._last_writing
        if late > GRACE:
            self.found.add(f"write in state {write.state}, {late:.3f} s after the last that writes")
        since = self._unsafe_since
        if since is not None and write.time - since > GRACE + self.bounds.cycle:
            self.found.add(
                f"write {write.time - since:.3f} s after the robot said it must not move"
            )

    def _check_fresh(self, write: Write) -> None:
        if self._fresh is None:
            self.found.add("write before any state")
            return
        age = write.time - self._fresh.time
        self._since_fresh += 1
        self.found.oldest_state = max(self.found.oldest_state, age)
        if age > self.bounds.fresh:
            self.found.add(f"write {age:.3f} s after the last fresh state")
        elif self._since_fresh > AHEAD + self.bounds.burst / self.bounds.cycle:
            self.found.add(f"{self._since_fresh} writes after one state")

    def _offset_of(self, write: Write) -> Numbers:
        """Return the TCP offset (6,) of a write, base axes, m and rad."""
        if write.kind == "offset":
            return write.values
        b = self.bounds
        if self._nominal is None:
            self._nominal = tcp_in_base(b.arm, write.values, b.tool)
            if self._fresh is not None:
                away = max(abs(x - y) for x, y in zip(write.values, self._fresh.q, strict=True))
                if away > START_AWAY:
                    self.found.add(f"a stream began {away:.4f} rad from where the arm was")
        if self._joints[0] != write.values or self._joints[1] is ZEROS:
            self._joints = (
                write.values,
                gap(self._nominal, tcp_in_base(b.arm, write.values, b.tool)),
            )
        return self._joints[1]

    def _check_size(self, write: Write, offset: Numbers) -> None:
        b = self.bounds
        length, turn = math.hypot(*offset[:3]), math.hypot(*offset[3:])
        self.found.largest_offset = max(self.found.largest_offset, length)
        if length > b.offset * 1.001 + b.grain:
            self.found.add(f"offset of {1e3 * length:.4f} mm, allowed {1e3 * b.offset:g}")
        if turn > b.rotation * 1.001 + b.grain_rotation:
            self.found.add(f"offset of {turn:.6f} rad, allowed {b.rotation:g}")

    def _check_step(self, write: Write, offset: Numbers) -> None:
        b, found = self.bounds, self.found
        shift, turn = _apart(offset, self._offset)
        found.largest_step, found.largest_turn = (
            max(found.largest_step, shift),
            max(found.largest_turn, turn),
        )
        if shift > b.offset_rate * GAP * b.cycle * 1.001 + 2.0 * b.grain:
            found.add(f"step of {1e3 * shift:.4f} mm at once")
        if turn > b.rotation_rate * GAP * b.cycle * 1.001 + 2.0 * b.grain_rotation:
            found.add(f"step of {turn:.6f} rad at once")
        stamp = write.time
        if self._fresh is not None and math.isfinite(self._fresh.stamp):
            stamp = self._fresh.stamp
        for then, before in self._recent:
            # a client may still write for a sample that is not the last one that it was sent
            slack = (GAP + 3.0) * b.cycle if stamp is not write.time else GRACE
            allowed = stamp - then + slack + b.burst
            shift, turn = _apart(offset, before)
            if shift > b.offset_rate * allowed * 1.001 + 2.0 * b.grain:
                found.add(f"{1e3 * shift:.4f} mm within {1e3 * (stamp - then):.1f} ms")
                break
        self._recent.append((stamp, offset))
        self._offset = offset


def _apart(a: Numbers, b: Numbers) -> tuple[float, float]:
    """Return how far two offsets are apart, m and rad."""
    return math.dist(a[:3], b[:3]), math.dist(a[3:], b[3:])
