"""The watch over the joints' zeros during a run: it collects rests and reports slips and forces.

Source of the test: ``core/diagnosis/rests/rest_comparison.py``.

A person who touches the arm makes a force that comes and goes: it does not repeat at the next
poses in the shares of a joint. It is reported as a force, and excluded from the comparison.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from gapbridge.bridge.ipc.events import Event, EventKind
from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.rests.rest_comparison import (
    LARGEST_SLIP,
    Rest,
    RestComparison,
    Slip,
    median,
    noise_of,
)
from gapbridge.core.diagnosis.rests.rest_model import Place, RestModel
from gapbridge.core.model import Model

STILL = 1e-3  # rad from the start of a rest, within which the arm is at rest
SETTLING = 0.1  # s at the start of a rest that are skipped
WINDOW = 0.3  # s of one mean
WINDOWS = 20  # per rest
SAME_POSE = 0.02  # rad
SAME_MASS = 0.01  # kg
APPROACH_STEP = 0.01  # rad: smallest motion that determines a joint's approach direction
MAX_RESTS = 120  # stored rests
MAX_POSES = 64  # stored poses; a program with more drops the least recent ones
LASTING_RESTS = 3  # rests in a row after which a force counts as permanent


class _Standstill:
    """The arm since it came to a stop at ``q`` (n,) rad, ``since`` s: means of short windows."""

    def __init__(self, q: Array, since: float) -> None:
        self.q, self.since = q, since
        self.windows: list[Array] = []
        self._last: Array | None = None  # window
        self._sum: Array | float = 0.0
        self._count, self._begun = 0, 0.0  # rows of the window, and s of the first

    def take(self, rows: Array, begun: float, ended: float) -> tuple[Array, Array] | None:
        """Return a finished window's mean, and its difference from the one before, if any."""
        self._begun = self._begun if self._count else begun
        self._sum, self._count = self._sum + rows.sum(axis=0), self._count + len(rows)
        if ended - self._begun < WINDOW:
            return None
        mean = np.asarray(self._sum / self._count)
        self._sum, self._count = 0.0, 0
        before, self._last = self._last, mean
        if len(self.windows) < WINDOWS:
            self.windows.append(mean)
        return None if before is None else (mean, mean - before)


class SlipWatch:
    """Compares the rests of a run with each other; ``model`` None, or ``smallest`` 0: never.

    ``slices``: where each field is in a cycle's row (SharedMemory.slices). ``smallest``: rad,
    of a slip that is reported.
    """

    def __init__(self, model: Model | None, slices: Mapping[str, slice], smallest: float) -> None:
        # bending is the same at each visit to a pose, and cancels
        self._model: RestModel | None = None
        if model is not None and smallest > 0.0:
            self._model = RestModel(model.without_terms())
        self._smallest = smallest
        self._stretch = 0
        names = (
            "actual_q", "ft_raw_wrench", "actual_TCP_force", "actual_current_as_torque", "payload",
            "payload_cog",
        )  # fmt: skip
        self._n = slices["actual_q"].stop - slices["actual_q"].start
        self._columns = np.concatenate([np.arange(slices[k].start, slices[k].stop) for k in names])
        self._time = slices["timestamp"].start
        self._q = slices["actual_q"]
        self.reset()

    def reset(self) -> None:
        """Start learning again: the arm has changed."""
        self._places: list[Place] = []
        self._rests: deque[Rest] = deque(maxlen=MAX_RESTS)
        self._standstill: _Standstill | None = None
        self._touched = False  # a force has come or gone during this rest
        self._previous_q: Array | None = None  # (n,) rad: the rest before this one
        self._under_force: list[Rest] = []  # rests in a row under a force
        self._sigma: Array | None = None  # (m,) of one rest

    def interrupt(self) -> None:
        """Forget the rest under way: cycles are missing, and the arm may have moved meanwhile."""
        self._standstill, self._touched = None, False
        self._previous_q, self._under_force = None, []
        self._stretch += 1

    @property
    def places(self) -> tuple[Place, ...]:
        """Return the poses to which the program has returned."""
        return tuple(self._places)

    @property
    def rests(self) -> tuple[Rest, ...]:
        """Return the rests that are compared, in their order."""
        return tuple(self._rests)

    def resume(
        self, poses: Sequence[tuple[Array, float, Array, bytes]], rests: Iterable[Rest]
    ) -> None:
        """Continue with the rests of an earlier run; ``poses``: arguments of RestModel.place."""
        self.reset()
        if self._model is not None:
            self._places = [self._model.place(*pose) for pose in poses]
            self._rests.extend(rests)
            self._sigma = noise_of(self._rests)

    @property
    def watches(self) -> bool:
        """Return whether anything is compared."""
        return self._model is not None

    @property
    def learned(self) -> bool:
        """Return whether enough poses were repeated to compare them."""
        return self._model is not None and self._sigma is not None

    @property
    def detail(self) -> str:
        """Return the progress as text."""
        if self._model is None:
            return "not watched"
        poses = len({rest.place for rest in self._rests})
        detail = f"{len(self._rests)} rests at {poses} poses compared"
        return detail if self.learned else f"{detail}; learning, until poses have come back"

    def take(self, rows: Array) -> list[Event]:
        """Return events of new findings. ``rows`` (k, width): cycles of the loop, in order."""
        if self._model is None or not len(rows):
            return []
        findings: list[Event] = []
        q, t = rows[:, self._q], rows[:, self._time]
        standing = self._standstill
        if (
            standing is None
            or np.abs(q - standing.q).max() > STILL
            or not standing.since <= t[-1]  # a new clock
        ):
            findings += self._end_rest(self._model)
            self._standstill, self._touched = _Standstill(q[-1].copy(), float(t[-1])), False
        elif t[0] >= standing.since + SETTLING:
            window = standing.take(rows[:, self._columns], float(t[0]), float(t[-1]))
            if window is not None:
                findings += self._force_step(self._model, *window, float(t[-1]))
        return findings

    def _comparison(self) -> RestComparison | None:
        """Return the rests so far; None while too few poses were repeated."""
        if self._sigma is None:
            return None
        return RestComparison(self._places, self.rests, self._sigma)

    def _force_step(self, model: RestModel, mean: Array, change: Array, now: float) -> list[Event]:
        """Report a force that changes while the arm is at rest, once a rest; not a slip."""
        comparison, n = self._comparison(), self._n
        if self._touched or comparison is None:
            return []
        size = float(np.linalg.norm(_first_finite(change[n : n + 3], change[n + 6 : n + 9])))
        weight = 9.81 * model.payload(mean)[0]
        self._touched = size > comparison.force_threshold(LARGEST_SLIP * weight)
        return [_force(size, now, "came or went while the arm was at rest")] * self._touched

    def _end_rest(self, model: RestModel) -> list[Event]:
        """Add the finished rest to the comparison."""
        standing = self._standstill
        if standing is None or not standing.windows:
            return []
        # the median window: a touch shorter than half of the rest has no effect
        mean = median(standing.windows)
        place = self._place_of(model, mean)
        readings = model.readings(mean, self._places[place])
        rest = Rest(place, standing.since, readings, self._stretch)
        self._previous_q = mean[: self._n]
        findings = self._forces(rest)
        if self._under_force:
            return findings
        self._rests.append(rest)
        self._sigma = noise_of(self._rests)
        comparison = self._comparison()
        slip = None if comparison is None else comparison.slip(self._smallest)
        if slip is not None:
            findings.append(slip_event(slip))
            self.reset()
        return findings

    def _forces(self, rest: Rest) -> list[Event]:
        """Exclude rests under a force, up to LASTING_RESTS in a row."""
        comparison = self._comparison()
        excess = None if comparison is None else comparison.excess_force(rest)
        if excess is None:
            self._under_force = []
            return []
        self._under_force.append(rest)
        if len(self._under_force) == 1:
            return [_force(excess, rest.time, "compared with earlier rests at this pose")]
        if len(self._under_force) > LASTING_RESTS:  # a slip, a load, or a sensor's new zero
            self._rests.extend(self._under_force[:-1])
            self._under_force = []
        return []

    def _place_of(self, model: RestModel, mean: Array) -> int:
        """Return the number of the pose, a new one if it was not seen yet."""
        n = self._n
        q, (mass, cog) = mean[:n], model.payload(mean)
        step = np.zeros(n) if self._previous_q is None else q - self._previous_q
        side = np.where(np.abs(step) > APPROACH_STEP, np.sign(step), 0).astype(np.int8).tobytes()
        for number, place in enumerate(self._places):
            near = np.abs(place.q - q).max() < SAME_POSE and abs(place.mass - mass) < SAME_MASS
            if near and place.side == side:
                return number
        if len(self._places) >= MAX_POSES:
            self._drop_oldest()
        self._places.append(model.place(q, mass, cog, side))
        return len(self._places) - 1

    def _drop_oldest(self) -> None:
        """Drop the pose that has not been seen for longest."""
        last = {rest.place: i for i, rest in enumerate(self._rests)}
        oldest = min(range(len(self._places)), key=lambda place: last.get(place, -1))
        del self._places[oldest]
        remaining = [
            replace(rest, place=rest.place - (rest.place > oldest))
            for rest in self._rests
            if rest.place != oldest
        ]
        self._rests = deque(remaining, maxlen=MAX_RESTS)


def slip_event(slip: Slip) -> Event:
    """Return the event of the run that reports a slip."""
    detail = (
        f"the zero of joint {' or '.join(map(str, slip.joints))} has moved by "
        f"{1e3 * slip.size:.1f} mrad (1 sigma {1e3 * slip.std:.1f}): in {slip.rests} rests in a "
        "row the readings have changed as this slip changes them, compared with earlier rests at "
        "the same poses"
    )
    return {
        "kind": EventKind.SLIP, "joints": list(slip.joints), "size": slip.size, "std": slip.std,
        "since": slip.since, "detail": detail,
    }  # fmt: skip


def _force(size: float, since: float, detail: str) -> Event:
    return {
        "kind": EventKind.WARNING, "what": "unexpected_force", "size": size, "since": since,
        "detail": f"an unexpected force of {size:.1f} N {detail}",
    }  # fmt: skip


def _first_finite(first: Array, second: Array) -> Array:
    return first if np.isfinite(first).all() else second
