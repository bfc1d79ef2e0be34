"""Testing whether a joint's zero has moved: readings at rest at the same pose, over a run.

A robot's program comes back to the same poses. What the flange sensor and the motors measure there
repeats but for noise, whatever the model gets wrong, so that each rest is compared with earlier
rests at its own pose. A zero that has slipped by delta turns the weights beyond the joint: every
pose then changes by its own known share, d(prediction)/dq_j times delta. The likelihood ratio of
that one number is tested at every rest for each joint and for several moments in the past (a
generalised likelihood-ratio test with nuisances: Basseville and Nikiforov, "Detection of Abrupt
Changes" (1993), ch. 2.4). A step of the sensor's or the motors' zeros, and of payload and its first
moment, is free on both sides, so that none of them counts as a slip.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.rests.rest_model import Place

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
DISTINCT_POSE = 0.1  # rad: poses closer than this count as one


@dataclass(frozen=True)
class Rest:
    """One rest of the arm."""

    place: int
    time: float  # s
    readings: Array  # (m,) less the model's; NaN where there is no such sensor
    stretch: int = -1  # of cycles without interruption; -1: in an earlier run


class Slip(NamedTuple):
    """A joint's zero that has moved."""

    joints: tuple[int, ...]  # from 1; the first explains most, the others as well as it
    size: float  # rad, of the first: the true angle is now the encoder's and this more
    std: float  # rad
    since: float  # s, of the first rest after it
    rests: int  # in a row that show it


class _Change(NamedTuple):
    """Difference of readings at one pose, after minus before a moment; whitened."""

    b: Array  # (k,)
    slip: Array  # (k, n)
    free: Array  # (k, f)


@dataclass(frozen=True)
class RestComparison:
    """Rests in their order, the poses whose numbers they have, and 1 sigma (m,) of one rest."""

    places: Sequence[Place]
    rests: Sequence[Rest]
    sigma: Array

    def force_threshold(self, slip: float) -> float:
        """Return the force, N, above which a change exceeds noise and a slip's ``slip``, N."""
        return slip + max(FORCE, FORCE_SIGMAS * float(self.sigma[:3].max()))

    def excess_force(self, rest: Rest) -> float | None:
        """Return a new rest's change of force, N, if it is too large for a slip, or None."""
        former = [
            r.readings
            for r in self.rests
            if r.place == rest.place and r.stretch == rest.stretch  # a sensor may be zeroed between
        ]
        if len(former) < 2:
            return None
        size = float(np.linalg.norm((rest.readings - median(former))[:3]))
        slip = LARGEST_SLIP * np.linalg.norm(self.places[rest.place].slip[:3], axis=0).max()
        return size if size > self.force_threshold(float(slip)) else None  # NaN: no sensor

    def slip(self, smallest: float) -> Slip | None:
        """Return the slip of at least ``smallest`` rad that the rests show, or None."""
        if not any(self._is_significant(length, smallest) for length in SUFFIXES):
            return None
        tried = {
            length: _ratios(self._changes(length))
            for length in range(SUFFIXES[0], SUFFIXES[-1] + 1)
        }
        known = {length: ratios for length, ratios in tried.items() if ratios is not None}
        strongest = max(known.values(), key=lambda ratios: float(ratios[0].max()))
        chi_square, count = self._chi_square(int(np.argmax(strongest[0]))), len(self.rests)
        length = min(known, key=lambda one: chi_square(count - one))  # the likeliest moment
        gains, values, stds, _ = known[length]
        order = np.argsort(-gains)
        joints = tuple(int(j) + 1 for j in order if gains[j] > gains[order[0]] - TIE_MARGIN)
        # as sure as the moment is: other moments that are nearly as likely have sizes of their own
        best = order[0]
        likely = [f[1][best] for f in known.values() if f[0][best] > gains[best] - TIE_MARGIN]
        size, std = float(values[best]), float(np.hypot(stds[best], np.std(likely)))
        return Slip(joints, size, std, self.rests[-length].time, length)

    def _is_significant(self, length: int, smallest: float) -> bool:
        """Return whether a slip before the last ``length`` rests is significant."""
        changes = self._changes(length)
        ratios = _ratios(changes)
        if ratios is None:
            return False
        gains, values, _, per_number = ratios
        j = int(np.argmax(gains))
        if gains[j] < THRESHOLD or per_number[j] > CONSISTENT or abs(values[j]) < smallest:
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
        count = len(self.rests)
        free = self._chi_square(None)
        return min(map(free, range(2, count - 1))) - self._chi_square(joint)(count - length)

    def _chi_square(self, joint: int | None) -> Callable[[int], float]:
        """Return a function: chi-square of all rests for steps of the free parameters at a moment.

        Each pose's own mean is fitted too, and where one is given the slip of a joint (from 0). A
        moment is the number of the first rest after it.
        """
        rests = self.rests
        number = np.array([rest.place for rest in rests])
        readings = np.array([rest.readings for rest in rests])
        finite = np.isfinite(readings).all(axis=0)
        scale = 1.0 / self.sigma[finite]
        places = [self.places[p] for p in number]
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
        if len(self.rests) <= length:
            return []
        old, new = _by_place(self.rests[:-length]), _by_place(self.rests[-length:])
        common = [p for p in new if len(old.get(p, ())) >= 2]
        if self._distinct(common) < MIN_POSES:
            return []
        changes = []
        for p in common:
            before, after, place = old[p], new[p], self.places[p]
            change = median(after) - median(before)
            # pi / 2: the variance of a median relative to that of a mean
            share = np.pi / 2.0 / len(before) + (np.pi / 2.0 if len(after) > 2 else 1.0) / len(
                after
            )
            scale = 1.0 / (self.sigma * np.sqrt(share))
            finite = np.isfinite(change)
            slip, free = (scale[:, None] * part for part in (place.slip, place.free))
            changes.append(_Change((change * scale)[finite], slip[finite], free[finite]))
        return changes

    def _distinct(self, places: list[int]) -> int:
        """Return how many of the poses differ from each other."""
        distinct: list[Array] = []
        for p in places:
            q = self.places[p].q
            if all(np.abs(q - other).max() > DISTINCT_POSE for other in distinct):
                distinct.append(q)
        return len(distinct)


def noise_of(rests: Iterable[Rest]) -> Array | None:
    """Return 1 sigma (m,) of one rest, from rests at one pose in a row; None: too few yet."""
    last: dict[int, Array] = {}
    steps = []
    for rest in rests:
        if rest.place in last:
            steps.append(rest.readings - last[rest.place])
        last[rest.place] = rest.readings
    if len(steps) < NOISE_SAMPLES:
        return None
    # the median: a slip, or a touch, among them does not raise it
    spread = 1.4826 * median(np.abs(steps)) / np.sqrt(2.0)
    return np.asarray(np.maximum(spread, np.repeat(FLOORS, (3, 3, len(spread) - 6))))


def median(values: Array | list[Array]) -> Array:
    """Return the median along the first axis; NaN where there are any. np.median takes longer."""
    ordered = np.sort(values, axis=0)  # NaN last
    half = 0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])
    return np.asarray(np.where(np.isnan(ordered[-1]), np.nan, half))


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


def _by_place(rests: Iterable[Rest]) -> dict[int, list[Array]]:
    readings: dict[int, list[Array]] = {}
    for rest in rests:
        readings.setdefault(rest.place, []).append(rest.readings)
    return readings
