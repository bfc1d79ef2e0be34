"""What the wrench, tracking and torque channels share: truth as a function of named values.

A place is an effect at a joint (from 1) or at none. The noise-free readings are a function of the
values at all places; sizing, clearness and the twin experiment follow from it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from benchmarks.blind.draws import Redraw
from benchmarks.blind.label import Cause
from benchmarks.blind.measuring import without
from benchmarks.blind.mechanics import Array

Place = tuple[str, int | None]
Values = dict[Place, Array]
CLEAR = 150.0
WHOLE_ARM = ("latency", "tracking_lag")


@dataclass(frozen=True)
class Candidate:
    """What an effect at a place can do: the names of its values, and a usual size of each."""

    names: tuple[str, ...]
    scale: Array
    limit: float = 30.0  # largest credible value, in usual sizes


@dataclass(frozen=True)
class Parametric:
    """The truth of one channel in one log."""

    read: Callable[[Values], Array]  # noise-free readings (N, k)
    sigma: Array  # (k,) noise of each column
    candidates: dict[Place, Candidate]

    def gap(self, values: Values) -> Array:
        """Return the readings minus those of the nominal model, in units of the noise, flat."""
        return ((self.read(values) - self.read({})) / self.sigma).ravel()

    def columns(self, places: Iterable[Place], around: Values) -> Array:
        """Return d gap / d value (m, k) of all values of some places, values in usual sizes."""
        at = self.gap(around)
        out = []
        for place in places:
            scale = self.candidates[place].scale
            for k in range(len(scale)):
                step = np.zeros(len(scale))
                step[k] = 1e-4 * scale[k]
                moved = around.get(place, np.zeros(len(scale))) + step
                out.append((self.gap({**around, place: moved}) - at) / 1e-4)
        return np.column_stack(out) if out else np.zeros((len(at), 0))

    def size(self, place: Place, values: Array, ratio: float) -> Array:
        """Return values so large that their gap is ``ratio`` x the floor; Redraw if incredible."""
        for _ in range(2):
            seen = float(np.sqrt(np.mean(self.gap({place: values}) ** 2)))
            if seen < 1e-9:
                raise Redraw
            values = values * ratio / seen
        candidate = self.candidates[place]
        if np.any(np.abs(values) > candidate.limit * candidate.scale):
            raise Redraw
        return values

    def all_clear(self, values: Values) -> bool:
        """Return whether each place shows beside the others, at the truth."""
        full = self.gap(values)
        for place in values:
            rest = {p: v for p, v in values.items() if p != place}
            left = without(self.columns(rest, values), full - self.gap(rest))
            if float(left @ left) < CLEAR:
                return False
        return True

    def left_over(self, gap: Array, places: Iterable[Place]) -> float:
        """Return the chi-square that some places leave of a noise-free gap, fitted to it."""
        known = [p for p in places if p in self.candidates]
        values: Values = {}
        left = gap
        for _ in range(4):  # Gauss-Newton: delays are not linear
            columns = self.columns(known, values)
            if columns.shape[1] == 0:
                break
            step = np.linalg.lstsq(columns, left, rcond=1e-9)[0]
            at = 0
            for place in known:
                scale = self.candidates[place].scale
                more = step[at : at + len(scale)] * scale
                values[place] = values.get(place, np.zeros(len(scale))) + more
                at += len(scale)
            left = gap - self.gap(values)
        return float(left @ left)

    def noisy(self, values: Values, rng: Generator) -> Array:
        """Return readings with noise."""
        clean = self.read(values)
        return clean + rng.normal(size=clean.shape) * self.sigma

    def causes(self, values: Values) -> tuple[Cause, ...]:
        """Return the label's causes of true values."""
        out = []
        for effect in dict.fromkeys(p[0] for p in values):
            own = [p for p in values if p[0] == effect]
            joints = tuple(sorted(p[1] for p in own if p[1] is not None))
            reported = {
                n: float(x)
                for p in own
                for n, x in zip(self.candidates[p].names, values[p], strict=True)
            }
            out.append(Cause(effect, joints, reported))
        return tuple(out)


def draw_values(
    truth: Parametric,
    effects: Iterable[str],
    rng: Generator,
    ratios: tuple[float, float],
    signed: Callable[[str], bool],
) -> Values:
    """Return random values of effects at one to three places each; Redraw where unclear."""
    values: Values = {}
    for effect in effects:
        places = [p for p in truth.candidates if p[0] == effect]
        if effect in WHOLE_ARM and rng.random() < 0.6:  # one cause delays all joints alike
            ratio = float(np.exp(rng.uniform(*np.log(ratios))))
            same = max(truth.size(p, truth.candidates[p].scale, ratio)[0] for p in places)
            values |= {p: np.array([same]) for p in places}
            continue
        count = min(int(rng.choice([1, 2, 3], p=[0.55, 0.3, 0.15])), len(places))
        for k in sorted(rng.permutation(len(places))[:count]):
            place = places[int(k)]
            scale = truth.candidates[place].scale
            shape = rng.normal(size=len(scale)) * scale
            if not signed(effect):
                shape = np.abs(shape)
            ratio = float(np.exp(rng.uniform(*np.log(ratios))))
            values[place] = truth.size(place, shape, ratio)
    if values and not truth.all_clear(values):
        raise Redraw
    return values
