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

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.plan import Payload
from gapbridge.core.calibration.reading_fit import ReadingFit, at_single_place, fit_readings
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
        fit = self._fitted(same, new)
        if fit is None:  # too few readings yet to know where the instrument stands
            return self._first(same, new)
        off, allowed, doubted = fit.compare(new)
        if not doubted:
            return Verdict(off, allowed, False)
        reasons, instead = self._reasons(fit, new, typed, joints)
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
        fit = self._fitted(same, old)
        if fit is None:
            return np.asarray((new.value - old.value)[0, :3])
        return fit.gap(new)[:3] - fit.gap(old)[:3]

    def poses(self, readings: Readings) -> Poses:
        """Return where the cell's model has the TCP at some readings."""
        return self._model.predict(readings.q, readings.loads)

    def _fitted(self, before: Readings, new: Readings) -> ReadingFit | None:
        """Return the fit to the readings ``before``; None where they are too few, or fit no arm."""
        registered = self._metrology.registered and int(new.station[0]) == 0
        before, new = at_single_place(before), at_single_place(new)
        observable = make_observable(self._kind, registered=registered, **self._options)
        layout = observable.layout(before if len(before) else new)
        needed = layout.size + SPARE.get(self._kind, 0)
        few = len(before) * observable.equations <= needed
        if observable.closes or (few and layout.size):
            return None
        if registered not in self._parameters:
            self._parameters[registered] = Parameters.of_effects(self._model, self._effects)
        own = self._parameters[registered]
        with contextlib.suppress(GapbridgeError):
            return fit_readings(before, new, own, observable, self._sigma)
        return None

    def _reasons(
        self, fit: ReadingFit, new: Readings, typed: bool, joints: bool
    ) -> tuple[list[str], Array | None]:
        reasons: list[str] = []
        instead: Array | None = None
        value = new.value[0]
        for factor, reason in UNITS.items():
            changed = value.copy()
            changed[:3] *= factor
            if fit.fits(replace(new, value=changed[None])):
                reasons.append(reason)
                instead = changed
        for other, reason in self._others(value) if typed or len(value) >= 3 else ():
            if fit.fits(replace(new, value=other[None])):
                reasons.append(reason)
        if typed and not reasons:
            reasons += [
                _coordinate(new, i, expected) for i, expected in fit.single_coordinates(new)
            ]
        reasons += self._other_loads(fit, new)
        if joints and not reasons:
            reasons += [_joint(new, i, angle) for i, angle in fit.single_joints(new)]
        return reasons, instead

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

    def _other_loads(self, fit: ReadingFit, new: Readings) -> list[str]:
        found = []
        for number, load in enumerate((*self._loads, Payload(0.0, name="nothing at all"))):
            if number == int(new.load[0]):
                continue
            loads = replace(
                new.loads, payload_mass=np.array([load.mass]), payload_cog=np.array([load.cog])
            )
            if fit.fits(replace(new, loads=loads)):
                name = load.name or f"{load.mass:g} kg"
                found.append(f"it fits if {name} hangs on the flange")
        return found


def _coordinate(new: Readings, i: int, expected: float) -> str:
    return (
        f"{AXES[i]} alone is off: {new.value[0, i] * 1e3:.3f} mm where about "
        f"{expected * 1e3:.1f} mm was expected; mistyped?"
    )


def _joint(new: Readings, i: int, angle: float) -> str:
    return (
        f"it fits if joint {i + 1} stands at {np.degrees(angle):.2f}° instead of "
        f"{np.degrees(new.q[0, i]):.2f}°"
    )


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
