"""What the next reading should be, from those so far, and what could be wrong with one that is off.

Model and instrument are fitted to the readings so far, every parameter held at the cell's model by
its usual size. A reading that is farther off than that allows is doubted, and what could have gone
wrong is tried: another unit, exchanged axes, one mistyped coordinate, another load, a joint.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtri

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.observables.predicted_readings import beside
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.plan import Payload
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.errors import GapbridgeError
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model, Poses

NEAREST = 0.02  # m: nothing on a tool comes nearer to an instrument's origin, or to a second ball
FARTHEST = 100.0  # m: no instrument of this kind looks farther
WIDEST = 3.0  # m between two balls on one tool
LOOSE, SHARE = 0.05, 0.1  # m, and share of a distance, by which an uncalibrated arm may be off
BALLS, BALLS_SHARE = 1e-3, 0.01  # the same for two balls, which no arm moves against each other
REPEATABILITY = 1e-4  # m, 1 sigma of one coordinate: of an arm of which nobody knows it
UNMODELLED = 1e-4  # m, 1 sigma: what a session cannot fit and still is no mistake
UNITS = {
    1e-3: "a thousand times too large: millimetres taken for metres?",
    1e3: "a thousand times too small: metres taken for millimetres?",
    1 / 25.4: "25.4 times too large: millimetres taken for inches?",
    25.4: "25.4 times too small: inches taken for millimetres?",
}
SPARE = {"distance": 4, "relative": 9}
"""Numbers beyond the unknowns, by kind: with fewer the instrument may be found in a wrong place."""
EXCHANGED = ((1, 0, 2), (2, 1, 0), (0, 2, 1), (1, 2, 0), (2, 0, 1))
RARE = 1e-5  # chance with which a good reading is doubted
USUAL = 3.0  # usual sizes: 1 sigma at which parameters are held
ROUNDS = 3
INLIER = 4.0  # noises: a reading that is off by more counts the less
STEP = 1e-5  # rad
PRIOR_FREEDOM = 12.0  # degrees of freedom by which the noise is held at what was thought of it
AXES = "xyz"


@dataclass(frozen=True)
class Verdict:
    """What a reading looks like beside those before it."""

    off: float  # m, distance from where it was expected; nan: nothing to compare with yet
    allowed: float  # m, how far a good one would be off at most
    doubted: bool
    reasons: tuple[str, ...] = ()  # what could have gone wrong, likeliest first
    instead: Array | None = None  # (k,) the reading, put right, where that is plain


NOTHING = Verdict(float("nan"), float("nan"), False)


@dataclass(frozen=True)
class FittedSoFar:
    """Parameters and instrument, fitted to the readings so far."""

    model: Model
    observable: Observable
    nuisance: Nuisance
    spread: Array  # (k, k) covariance of the reading that is judged

    @classmethod
    def to(
        cls, before: Readings, new: Readings, parameters: Parameters, observable: Observable,
        sigma: float,
    ) -> FittedSoFar:  # fmt: skip
        """Fit to the readings ``before``, outliers down-weighted, to judge ``new`` (one row).

        Derivatives by the parameters are taken once, at the nominal model: all are small.
        """
        held, p = USUAL * parameters.scales, len(parameters)
        values, count = np.zeros(p), len(before)
        first = count > 0 and observable.layout(before).size > 0
        nuisance = observable.start(parameters.nominal, before) if first else Nuisance.zero()
        both = beside(before, new)
        every, frames = observable.columns(parameters, values, both, nuisance)
        J, k = every[: count * observable.equations], observable.equations
        layout = observable.layout(both)
        prior = np.concatenate([1 / held**2, np.zeros(layout.size)])
        covariance = np.diag(np.concatenate([held**2, np.zeros(layout.size)]))
        for _ in range(ROUNDS if count else 0):
            scale = np.tile(observable.sigmas, count) * sigma
            poses = parameters.model(values).predict(before.q, before.loads)
            left = observable.gap(poses, before, nuisance).ravel() / scale
            F = observable.nuisance_columns(poses, before, nuisance)
            root = np.repeat(_weights(left.reshape(count, k)), k)
            A, left = np.hstack([J, F]) / scale[:, None] * root[:, None], left * root
            covariance = _inverse(A, prior, held)
            pull = A.T @ left - prior * np.concatenate([values, np.zeros(layout.size)])
            step = covariance @ pull
            values = values + step[:p]
            nuisance = nuisance.moved(step[p:], layout)
            sigma *= _quieter(left - A @ step, A, covariance)
        last = np.hstack([every[-k:], frames[-k:]])
        spread = last @ covariance @ last.T + np.diag((sigma * observable.sigmas) ** 2)
        return cls(parameters.model(values), observable, nuisance, spread)

    def gap(self, new: Readings) -> Array:
        """Return measured minus expected (k,) of one reading."""
        return np.asarray(self.observable.residual(self.model, here(new), self.nuisance)[0])

    def compare(self, new: Readings) -> tuple[float, float, bool]:
        """Return how far a reading is off, how far it may be (m), and whether it is too far."""
        left = self.gap(new)
        distance = float(left @ np.linalg.solve(self.spread, left))
        limit = float(chdtri(len(left), RARE))
        off = float(np.linalg.norm(left[:3]))
        allowed = float(np.sqrt(limit * np.linalg.eigvalsh(self.spread[:3, :3])[-1]))
        return off, allowed, distance > limit

    def alone(self, new: Readings) -> list[str]:
        """Return which single coordinate is off, the others being right."""
        observable = self.observable
        new = here(new)
        if new.value.shape[1] < 3:
            return []
        expected = observable.predict(self.model, new, self.nuisance)[0]
        found = []
        for i in range(3):
            value = new.value[0].copy()
            value[i] = expected[i]
            if not self.compare(replace(new, value=value[None]))[2]:
                found.append(
                    f"{AXES[i]} alone is off: {new.value[0, i] * 1e3:.3f} mm where about "
                    f"{expected[i] * 1e3:.1f} mm was expected; mistyped?"
                )
        return found

    def one_joint(self, new: Readings) -> list[str]:
        """Return which single joint angle, put right, explains the reading."""
        observable = self.observable
        new, model = here(new), self.model
        found = []
        for i in range(new.q.shape[1]):
            q = new.q.copy()
            for _ in range(6):  # Newton on one joint
                left = observable.residual(model, replace(new, q=q), self.nuisance)[0]
                turned = q.copy()
                turned[0, i] += STEP
                right = observable.residual(model, replace(new, q=turned), self.nuisance)[0]
                slope = (right - left) / STEP
                q[0, i] -= float(slope @ left) / max(float(slope @ slope), 1e-12)
            if not self.compare(replace(new, q=q))[2]:
                found.append(
                    f"it fits if joint {i + 1} stands at {np.degrees(q[0, i]):.2f}° instead of "
                    f"{np.degrees(new.q[0, i]):.2f}°"
                )
        return found


def here(readings: Readings) -> Readings:
    """Return readings as if there were one place of the instrument, and one target."""
    zero = np.zeros(len(readings), dtype=np.int64)
    return replace(readings, station=zero, target=zero)


def _inverse(A: Array, prior: Array, held: Array) -> Array:
    """Return the covariance of parameters, held by ``prior``, and of free nuisances."""
    free = np.maximum(np.linalg.norm(A[:, len(held) :], axis=0), 1e-12)
    size = np.concatenate([held, 1 / free])
    inner = (A * size).T @ (A * size) + np.diag(prior * size**2)
    return np.asarray(np.linalg.pinv(inner, rcond=1e-13, hermitian=True) * np.outer(size, size))


def _quieter(left: Array, A: Array, covariance: Array) -> float:
    """Return by which share the noise is other than thought; with few readings, hardly."""
    freedom = len(left) - float(np.einsum("ij,jk,ik->", A, covariance, A))
    square = (float(left @ left) + PRIOR_FREEDOM) / (max(freedom, 0.0) + PRIOR_FREEDOM)
    return float(np.clip(np.sqrt(square), 0.5, 2.0))


def _weights(left: Array) -> Array:
    """Return weights' roots (N,) for residuals (N, k) in units of the noise."""
    return np.asarray(1 / np.sqrt(1 + (np.linalg.norm(left, axis=1) / INLIER) ** 2))


class ReadingCheck:
    """Judges readings of one session; cheap enough to be asked after each."""

    def __init__(
        self, model: Model, metrology: Metrology, kind: str, sigma: float,
        effects: tuple[str, ...], loads: tuple[Payload, ...], options: dict[str, Any] | None = None,
    ) -> None:  # fmt: skip
        self._model, self._metrology, self._kind, self._loads = model, metrology, kind, loads
        self._effects, self._options = effects, options or {}
        arm = metrology.repeatability or REPEATABILITY
        self._sigma = float(np.hypot(np.hypot(sigma, arm), UNMODELLED))
        self._parameters: dict[bool, Parameters] = {}

    @property
    def compares(self) -> bool:
        """Return whether two readings of one pose can be held against each other."""
        return not make_observable(self._kind, **self._options).closes

    def judge(self, before: Readings, new: Readings, typed: bool, joints: bool) -> Verdict:
        """Judge one new reading (a Readings of one row) by those before it.

        ``typed``: a person has typed it; ``joints``: the joint angles were typed.
        """
        same = before[(before.station == new.station[0]) & (before.target == new.target[0])]
        state = self._fitted(same, new)
        if state is None:  # too few readings yet to know where the instrument stands
            return self._first(same, new)
        off, allowed, doubted = state.compare(new)
        if not doubted:
            return Verdict(off, allowed, False)
        reasons, instead = self._reasons(state, new, typed, joints)
        return Verdict(off, allowed, True, tuple(reasons), instead)

    def _first(self, before: Readings, new: Readings) -> Verdict:
        """Return what reach, and the readings before it, say of one of the first readings."""
        tip = np.concatenate([self.poses(before).position, self.poses(new).position])
        failed = early_check(before, new, tip)
        if failed is None:
            return NOTHING
        reasons = [failed[2]]
        instead: Array | None = None
        for factor, reason in UNITS.items():
            value = new.value.copy()
            value[:, :3] *= factor
            if early_check(before, replace(new, value=value), tip) is None and len(before):
                reasons.append(reason)
                instead = value[0]
        if not len(before):
            reasons.append("is the unit right?")
        return Verdict(failed[0], failed[1], True, tuple(reasons), instead)

    def shift(self, old: Readings, new: Readings, before: Readings) -> Array:
        """Return how far a pose's reading has gone (k,), m, base axes where they are known.

        The way that the arm itself has gone between the two is taken off.
        """
        same = before[(before.station == old.station[0]) & (before.target == old.target[0])]
        state = self._fitted(same, old)
        if state is None:
            return np.asarray((new.value - old.value)[0, :3])
        return state.gap(new)[:3] - state.gap(old)[:3]

    def poses(self, readings: Readings) -> Poses:
        """Return where the cell's model has the TCP at some readings."""
        return self._model.predict(readings.q, readings.loads)

    def _fitted(self, before: Readings, new: Readings) -> FittedSoFar | None:
        """Return the fit to the readings ``before``; None where they are too few, or fit no arm."""
        registered = self._metrology.registered and int(new.station[0]) == 0
        before, new = here(before), here(new)
        observable = make_observable(self._kind, registered=registered, **self._options)
        layout = observable.layout(before if len(before) else new)
        needed = layout.size + SPARE.get(self._kind, 0)
        few = len(before) * observable.equations <= needed
        if observable.closes or (few and layout.size):
            return None
        if registered not in self._parameters:
            self._parameters[registered] = Parameters.every(self._model, self._effects)
        own = self._parameters[registered]
        with contextlib.suppress(GapbridgeError):
            return FittedSoFar.to(before, new, own, observable, self._sigma)
        return None

    def _reasons(
        self, state: FittedSoFar, new: Readings, typed: bool, joints: bool
    ) -> tuple[list[str], Array | None]:
        reasons: list[str] = []
        instead: Array | None = None
        value = new.value[0]
        for factor, reason in UNITS.items():
            changed = value.copy()
            changed[:3] *= factor
            if self._fits(state, new, changed):
                reasons.append(reason)
                instead = changed
        for other, reason in self._others(value) if typed or len(value) >= 3 else ():
            if self._fits(state, new, other):
                reasons.append(reason)
        if typed and not reasons:
            reasons += state.alone(new)
        reasons += self._other_loads(state, new)
        if joints and not reasons:
            reasons += state.one_joint(new)
        return reasons, instead

    def _fits(self, state: FittedSoFar, new: Readings, value: Array) -> bool:
        return not state.compare(replace(new, value=value[None]))[2]

    @staticmethod
    def _others(value: Array) -> Iterator[tuple[Array, str]]:
        """Yield the reading with axes exchanged, or a sign turned round."""
        if len(value) < 3:
            return
        for order in EXCHANGED:
            changed = value.copy()
            changed[:3] = value[list(order)]
            yield changed, f"it fits with its axes in the order {' '.join(AXES[i] for i in order)}"
        for i in range(3):
            changed = value.copy()
            changed[i] *= -1
            yield changed, f"it fits with the sign of {AXES[i]} turned round"

    def _other_loads(self, state: FittedSoFar, new: Readings) -> list[str]:
        found = []
        for number, load in enumerate((*self._loads, Payload(0.0, name="nothing at all"))):
            if number == int(new.load[0]):
                continue
            loads = replace(
                new.loads, payload_mass=np.array([load.mass]), payload_cog=np.array([load.cog])
            )
            if not state.compare(replace(new, loads=loads))[2]:
                name = load.name or f"{load.mass:g} kg"
                found.append(f"it fits if {name} hangs on the flange")
        return found


def early_check(before: Readings, new: Readings, tip: Array) -> tuple[float, float, str] | None:
    """Return how far a reading is off (m), how far it may be, and why it is doubted; None: not.

    ``new`` is one reading, ``tip`` (N + 1, 3) m where the cell's model has the TCP at those
    ``before`` and then at the new one, base.
    """
    value = new.value[0, :3]
    if not len(value):
        return None
    checks: dict[str, Callable[[], tuple[float, float, str] | None]] = {
        "position": lambda: _points(before, value, tip),
        "pose": lambda: _points(before, value, tip),
        "distance": lambda: _distances(before, float(value[0]), tip),
        "relative": lambda: _balls(before, value),
    }
    check = checks.get(new.kind)
    return check() if check else None


def _points(before: Readings, value: Array, tip: Array) -> tuple[float, float, str] | None:
    far = float(np.linalg.norm(value))
    if not NEAREST <= far <= FARTHEST:
        return _off(far, NEAREST if far < NEAREST else FARTHEST, "from the instrument's origin")
    for i, earlier in enumerate(before.value[:, :3]):
        apart = float(np.linalg.norm(value - earlier))
        meant = float(np.linalg.norm(tip[-1] - tip[i]))
        allowed = LOOSE + SHARE * meant
        if abs(apart - meant) > allowed:
            reason = (
                f"it is {1e3 * apart:.1f} mm from an earlier reading here; the joints put the two "
                f"{1e3 * meant:.0f} mm apart"
            )
            return abs(apart - meant), allowed, reason
    return None


def _distances(before: Readings, value: float, tip: Array) -> tuple[float, float, str] | None:
    if abs(value) > FARTHEST:
        return _off(abs(value), FARTHEST, "from the fixed end")
    for i, earlier in enumerate(before.value[:, 0]):
        meant = float(np.linalg.norm(tip[-1] - tip[i]))
        change, allowed = abs(value - float(earlier)), meant + LOOSE + SHARE * meant
        if change > allowed:
            reason = (
                f"it differs by {1e3 * change:.1f} mm from an earlier reading; the joints put the "
                f"two {1e3 * meant:.0f} mm apart"
            )
            return change, allowed, reason
    return None


def _balls(before: Readings, value: Array) -> tuple[float, float, str] | None:
    far = float(np.linalg.norm(value))
    if not NEAREST <= far <= WIDEST:
        return _off(far, NEAREST if far < NEAREST else WIDEST, "between the balls")
    for earlier in before.value:
        apart = float(np.linalg.norm(earlier))
        allowed = BALLS + BALLS_SHARE * apart
        if abs(far - apart) > allowed:
            reason = f"the balls are {1e3 * far:.1f} mm apart, {1e3 * apart:.1f} mm before"
            return abs(far - apart), allowed, reason
    return None


def _off(far: float, limit: float, where: str) -> tuple[float, float, str]:
    side = "at least" if far < limit else "at most"
    reason = f"{1e3 * far:.3f} mm {where}, expected {side} {1e3 * limit:.0f} mm"
    return abs(far - limit), 0.0, reason
