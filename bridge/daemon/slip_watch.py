"""Detecting a joint whose zero has moved: readings at rest at the same pose, over a run.

A robot's program comes back to the same poses. What the flange sensor and the motors measure there
repeats but for noise, whatever the model gets wrong, so that each rest is compared with earlier
rests at its own pose. A zero that has slipped by delta turns the weights beyond the joint: every
pose then changes by its own known share, d(prediction)/dq_j times delta. The likelihood ratio of
that one number is tested at every rest for each joint and for several moments in the past (a
generalised likelihood-ratio test with nuisances: Basseville and Nikiforov, "Detection of Abrupt
Changes" (1993), ch. 2.4). A step of the sensor's or the motors' zeros, and of payload and its first
moment, is free on both sides, so that none of them counts as a slip.

A person who touches the arm makes a force that comes and goes: it does not repeat at the next
poses in the shares of a joint. It is reported as a force, and excluded from the comparison.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gapbridge.bridge.daemon.rest_model import Place, RestModel
from gapbridge.bridge.ipc.events import Event, EventKind
from gapbridge.core.arrays import Array
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
SUFFIXES = (4, 5, 6, 8, 12, 18, 27, 40)  # rests since the moment that is tried
NOISE_SAMPLES = 18  # differences between rests at one pose for the noise estimate
MIN_POSES = 4  # poses that a slip must show at
LEAD_OVER_STEPS = 0.5  # of the threshold: how far a slip is ahead of any step of zeros and payload
LEFT_OUT = 0.25  # share of the threshold that a slip keeps whichever pose is left out
THRESHOLD = 45.0  # of the likelihood ratio (chi-square of one number)
CONSISTENT = 3.0  # largest chi-square per number after fitting a slip
TIE_MARGIN = 9.0  # of the ratio: joints within it of the best one are reported too
FLOORS = (0.05, 0.005, 0.05)  # N, Nm of the flange sensor, Nm of a motor: 1 sigma at least
LARGEST_SLIP = 0.05  # rad: larger changes are forces
FORCE = 1.0  # N on top of that
FORCE_SIGMAS = 8.0
LASTING_RESTS = 3  # rests in a row after which a force counts as permanent
DISTINCT_POSE = 0.1  # rad: poses closer than this count as one


@dataclass(frozen=True)
class Slip:
    """A joint's zero that has moved."""

    joints: tuple[int, ...]  # from 1; the first explains most, the others as well as it
    size: float  # rad, of the first: the true angle is now the encoder's and this more
    std: float  # rad
    since: float  # s, controller's clock: the first rest after it
    detail: str

    @property
    def event(self) -> Event:
        """Return the event of the run that reports it."""
        return {
            "kind": EventKind.SLIP, "joints": list(self.joints), "size": self.size, "std": self.std,
            "since": self.since, "detail": self.detail,
        }  # fmt: skip


@dataclass(frozen=True)
class Force:
    """An external force that changed or lasted during a rest."""

    size: float  # N
    since: float  # s, controller's clock
    detail: str

    @property
    def event(self) -> Event:
        """Return the event of the run that reports it."""
        return {
            "kind": EventKind.WARNING, "what": "unexpected_force", "size": self.size,
            "since": self.since, "detail": self.detail,
        }  # fmt: skip


@dataclass(frozen=True)
class Rest:
    """One rest of the arm."""

    place: int
    time: float  # s
    readings: Array  # (m,) less the model's; NaN where there is no such sensor
    stretch: int = -1  # of cycles without interruption; -1: in an earlier run


class _Change(NamedTuple):
    """Difference of readings at one pose, after minus before a moment; whitened."""

    b: Array  # (k,)
    slip: Array  # (k, n)
    free: Array  # (k, f)


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
        n = slices["actual_q"].stop - slices["actual_q"].start
        self._n = n
        self._columns = np.concatenate([np.arange(slices[k].start, slices[k].stop) for k in names])
        self._time = slices["timestamp"].start
        self._q = slices["actual_q"]
        self._floor = np.repeat(FLOORS, (3, 3, n))
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
            self._sigma = self._noise()

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

    def take(self, rows: Array) -> list[Slip | Force]:
        """Return new findings. ``rows`` (k, width): cycles of the loop, in order."""
        if self._model is None or not len(rows):
            return []
        findings: list[Slip | Force] = []
        q, t = rows[:, self._q], rows[:, self._time]
        standing = self._standstill
        if (
            standing is None
            or np.abs(q - standing.q).max() > STILL
            or not standing.since <= t[-1]  # a new clock
        ):
            findings += self._end_rest()
            self._standstill, self._touched = _Standstill(q[-1].copy(), float(t[-1])), False
        elif t[0] >= standing.since + SETTLING:
            window = standing.take(rows[:, self._columns], float(t[0]), float(t[-1]))
            findings += [] if window is None else self._force_step(*window, float(t[-1]))
        return findings

    # -- one rest ---------------------------------------------------------------------------------

    def _force_step(self, mean: Array, change: Array, now: float) -> list[Slip | Force]:
        """Report a force that changes while the arm is at rest, once a rest; not a slip."""
        if self._touched or self._sigma is None:
            return []
        assert self._model is not None
        n = self._n
        size = float(np.linalg.norm(_first_finite(change[n : n + 3], change[n + 6 : n + 9])))
        self._touched = size > self._threshold(LARGEST_SLIP * 9.81 * self._model.payload(mean)[0])
        return [_force(size, now, "came or went while the arm was at rest")] * self._touched

    def _threshold(self, slip: float) -> float:
        """Return the force, N, above which a change exceeds noise and a slip's ``slip``, N."""
        assert self._sigma is not None
        return slip + max(FORCE, FORCE_SIGMAS * float(self._sigma[:3].max()))

    def _end_rest(self) -> list[Slip | Force]:
        """Add the finished rest to the comparison."""
        standing = self._standstill
        if standing is None or not standing.windows:
            return []
        assert self._model is not None
        # the median window: a touch shorter than half of the rest has no effect
        mean = _median(standing.windows)
        place = self._place_of(mean)
        readings = self._model.readings(mean, self._places[place])
        rest = Rest(place, standing.since, readings, self._stretch)
        self._previous_q = mean[: self._n]
        findings = self._forces(rest)
        if self._under_force:
            return findings
        self._rests.append(rest)
        self._sigma = self._noise()
        slip = self._slip()
        if slip is not None:
            findings.append(slip)
            self.reset()
        return findings

    def _forces(self, rest: Rest) -> list[Slip | Force]:
        """Exclude rests under a force, up to LASTING_RESTS in a row."""
        excess = self._excess(rest)
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

    def _excess(self, rest: Rest) -> float | None:
        """Return the change of force, N, at a pose if it is too large for a slip, or None."""
        former = [
            r.readings
            for r in self._rests
            if r.place == rest.place and r.stretch == rest.stretch  # a sensor may be zeroed between
        ]
        if self._sigma is None or len(former) < 2:
            return None
        size = float(np.linalg.norm((rest.readings - _median(former))[:3]))
        slip = LARGEST_SLIP * np.linalg.norm(self._places[rest.place].slip[:3], axis=0).max()
        return size if size > self._threshold(float(slip)) else None  # NaN: no sensor

    def _place_of(self, mean: Array) -> int:
        """Return the number of the pose, a new one if it was not seen yet."""
        assert self._model is not None
        n = self._n
        q, (mass, cog) = mean[:n], self._model.payload(mean)
        step = np.zeros(n) if self._previous_q is None else q - self._previous_q
        side = np.where(np.abs(step) > APPROACH_STEP, np.sign(step), 0).astype(np.int8).tobytes()
        for number, place in enumerate(self._places):
            near = np.abs(place.q - q).max() < SAME_POSE and abs(place.mass - mass) < SAME_MASS
            if near and place.side == side:
                return number
        if len(self._places) >= MAX_POSES:
            self._drop_oldest()
        self._places.append(self._model.place(q, mass, cog, side))
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

    # -- the test ---------------------------------------------------------------------------------

    def _noise(self) -> Array | None:
        """Return 1 sigma (m,) of one rest, from rests at one pose in a row; None: too few yet."""
        last: dict[int, Array] = {}
        steps = []
        for rest in self._rests:
            if rest.place in last:
                steps.append(rest.readings - last[rest.place])
            last[rest.place] = rest.readings
        if len(steps) < NOISE_SAMPLES:
            return None
        # the median: a slip, or a touch, among them does not raise it
        spread = 1.4826 * _median(np.abs(steps)) / np.sqrt(2.0)
        return np.asarray(np.maximum(spread, self._floor))

    def _slip(self) -> Slip | None:
        """Return the slip that the rests show, or None."""
        if self._sigma is None or not any(self._is_significant(length) for length in SUFFIXES):
            return None
        tried = {
            length: _ratios(self._changes(length))
            for length in range(SUFFIXES[0], SUFFIXES[-1] + 1)
        }
        known = {length: ratios for length, ratios in tried.items() if ratios is not None}
        strongest = max(known.values(), key=lambda ratios: float(ratios[0].max()))
        chi_square, count = self._chi_square(int(np.argmax(strongest[0]))), len(self._rests)
        length = min(known, key=lambda one: chi_square(count - one))  # the likeliest moment
        gains, values, stds, _ = known[length]
        order = np.argsort(-gains)
        joints = tuple(int(j) + 1 for j in order if gains[j] > gains[order[0]] - TIE_MARGIN)
        # as sure as the moment is: other moments that are nearly as likely have sizes of their own
        best = order[0]
        likely = [f[1][best] for f in known.values() if f[0][best] > gains[best] - TIE_MARGIN]
        size, std = float(values[best]), float(np.hypot(stds[best], np.std(likely)))
        return Slip(
            joints, size, std, list(self._rests)[-length].time,
            f"the zero of joint {' or '.join(map(str, joints))} has moved by {1e3 * size:.1f} mrad "
            f"(1 sigma {1e3 * std:.1f}): in {length} rests in a row the readings have changed as "
            "this slip changes them, compared with earlier rests at the same poses",
        )  # fmt: skip

    def _is_significant(self, length: int) -> bool:
        """Return whether a slip before the last ``length`` rests is significant."""
        changes = self._changes(length)
        ratios = _ratios(changes)
        if ratios is None:
            return False
        gains, values, _, per_number = ratios
        j = int(np.argmax(gains))
        if gains[j] < THRESHOLD or per_number[j] > CONSISTENT or abs(values[j]) < self._smallest:
            return False
        for i in range(len(changes)):  # a hand on the arm is at one pose, a slip at all
            part = _ratios(changes[:i] + changes[i + 1 :])
            if part is None or part[0][j] < LEFT_OUT * THRESHOLD or part[1][j] * values[j] < 0.0:
                return False
        return self._lead_over_steps(length, j) > LEAD_OVER_STEPS * THRESHOLD

    def _lead_over_steps(self, length: int, joint: int) -> float:
        """Return how much lower chi-square is with a slip than with free steps at any moment.

        A sensor that was zeroed two rests before a moment looks like a slip at that moment.
        """
        count = len(self._rests)
        free = self._chi_square(None)
        return min(map(free, range(2, count - 1))) - self._chi_square(joint)(count - length)

    def _chi_square(self, joint: int | None) -> Callable[[int], float]:
        """Return a function: chi-square of all rests for steps of the free parameters at a moment.

        Each pose's own mean is fitted too, and where one is given the slip of a joint (from 0). A
        moment is the number of the first rest after it.
        """
        rests = list(self._rests)
        number = np.array([rest.place for rest in rests])
        readings = np.array([rest.readings for rest in rests])
        finite = np.isfinite(readings).all(axis=0)
        assert self._sigma is not None
        scale = 1.0 / self._sigma[finite]
        places = [self._places[p] for p in number]
        columns = np.array([place.free[finite] * scale[:, None] for place in places])
        if joint is not None:
            slip = np.array([place.slip[finite, joint] * scale for place in places])
            columns = np.concatenate([columns, slip[:, :, None]], axis=2)
        same = (number[:, None] == number).astype(float)
        same /= same.sum(axis=1, keepdims=True)
        b = readings[:, finite] * scale
        b = (b - same @ b).ravel()

        def chi_square(moment: int) -> float:
            stepped = np.where(np.arange(len(rests))[:, None, None] >= moment, columns, 0.0)
            A = (stepped - np.einsum("ij,jkl->ikl", same, stepped)).reshape(len(b), -1)
            return float(np.sum((b - A @ np.linalg.lstsq(A, b, rcond=1e-6)[0]) ** 2))

        return chi_square

    def _changes(self, length: int) -> list[_Change]:
        """Return how the last rests differ from those before, pose by pose.

        Empty where too few poses were seen before and after.
        """
        rests = list(self._rests)
        if self._sigma is None or len(rests) <= length:
            return []
        old, new = _by_place(rests[:-length]), _by_place(rests[-length:])
        common = [p for p in new if len(old.get(p, ())) >= 2]
        if self._distinct(common) < MIN_POSES:
            return []
        changes = []
        for p in common:
            before, after, place = old[p], new[p], self._places[p]
            change = _median(after) - _median(before)
            # pi / 2: the variance of a median relative to that of a mean
            share = np.pi / 2.0 / len(before) + (np.pi / 2.0 if len(after) > 2 else 1.0) / len(
                after
            )
            scale = 1.0 / (self._sigma * np.sqrt(share))
            finite = np.isfinite(change)
            slip, free = (scale[:, None] * part for part in (place.slip, place.free))
            changes.append(_Change((change * scale)[finite], slip[finite], free[finite]))
        return changes

    def _distinct(self, places: list[int]) -> int:
        """Return how many of the poses differ from each other."""
        distinct: list[Array] = []
        for p in places:
            q = self._places[p].q
            if all(np.abs(q - other).max() > DISTINCT_POSE for other in distinct):
                distinct.append(q)
        return len(distinct)


def _ratios(changes: list[_Change]) -> tuple[Array, Array, Array, Array] | None:
    """Return of each joint's column alone: ratio, value, 1 sigma, chi-square left per number.

    What is free is projected out first. None where that leaves nothing to compare.
    """
    if not changes:
        return None
    b, slip, free = (np.concatenate(part) for part in zip(*changes, strict=True))
    U, s, _ = np.linalg.svd(free / np.maximum(np.linalg.norm(free, axis=0), 1e-12), False)
    U = U[:, s > 1e-6 * s[0]]
    freedom = len(b) - U.shape[1] - 1
    if freedom < 1:
        return None
    unprojected = np.linalg.norm(slip, axis=0)
    b, slip = b - U @ (U.T @ b), slip - U @ (U.T @ slip)
    size = np.linalg.norm(slip, axis=0)
    visible = size > np.maximum(1e-3 * unprojected, 1e-9)
    size = np.where(visible, size, 1.0)
    along = np.where(visible, (slip / size).T @ b, 0.0)
    return along**2, along / size, 1.0 / size, (float(b @ b) - along**2) / freedom


def _median(values: Array | list[Array]) -> Array:
    """Return the median along the first axis; NaN where there are any. np.median takes longer."""
    ordered = np.sort(values, axis=0)  # NaN last
    half = 0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])
    return np.asarray(np.where(np.isnan(ordered[-1]), np.nan, half))


def _by_place(rests: list[Rest]) -> dict[int, list[Array]]:
    readings: dict[int, list[Array]] = {}
    for rest in rests:
        readings.setdefault(rest.place, []).append(rest.readings)
    return readings


def _first_finite(first: Array, second: Array) -> Array:
    return first if np.isfinite(first).all() else second


def _force(size: float, since: float, detail: str) -> Force:
    return Force(size, since, f"an unexpected force of {size:.1f} N {detail}")
