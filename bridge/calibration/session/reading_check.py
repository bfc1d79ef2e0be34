"""Predicts the next reading from those so far, and explains one that is implausible.

Model and instrument are fitted to the readings so far, with a prior of usual size on every
parameter. If a reading is outside the predicted range, possible mistakes are tested: another unit,
exchanged axes, one mistyped coordinate, another load, a mistyped joint.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gapbridge.bridge.calibration.instruments.numbers import MAX_RANGE
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.plan import Payload
from gapbridge.core.calibration.reading_fit import ReadingFit, at_single_place, fit_readings
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.errors import GapbridgeError
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model, Poses

MIN_DISTANCE = 0.02  # m, of the target from the instrument's origin, or between two balls
MAX_BALL_DISTANCE = 3.0  # m between two balls
TOLERANCE, RELATIVE_TOLERANCE = 0.05, 0.1  # m, share of a distance: error of an uncalibrated arm
BALL_TOLERANCE, RELATIVE_BALL_TOLERANCE = 1e-3, 0.01  # m, share: error of the distance of two balls
REPEATABILITY = 1e-4  # m, 1 sigma of one coordinate, if the cell does not give it
UNMODELLED = 1e-4  # m, 1 sigma of one coordinate: error of the model that no parameter covers
UNIT_ERRORS = {
    1e-3: "a thousand times too large: millimetres taken for metres?",
    1e3: "a thousand times too small: metres taken for millimetres?",
    1 / 25.4: "25.4 times too large: millimetres taken for inches?",
    25.4: "25.4 times too small: inches taken for millimetres?",
}
REDUNDANCY = {"distance": 4, "relative": 9}
"""Equations beyond the unknowns, by kind, that are needed to locate the instrument reliably."""
RANGES = {
    "position": (MIN_DISTANCE, MAX_RANGE, "from the instrument's origin"),
    "pose": (MIN_DISTANCE, MAX_RANGE, "from the instrument's origin"),
    "distance": (0.0, MAX_RANGE, "from the fixed end"),
    "relative": (MIN_DISTANCE, MAX_BALL_DISTANCE, "between the balls"),
}
"""Smallest and largest plausible length of a reading, m, by kind, and what it is."""
AXIS_ORDERS = ((1, 0, 2), (2, 1, 0), (0, 2, 1), (1, 2, 0), (2, 0, 1))
AXES = "xyz"


@dataclass(frozen=True)
class Verdict:
    """The check of one reading against the readings before it."""

    deviation: float  # m, from the prediction; nan: no prediction yet
    limit: float  # m, largest plausible deviation; 0: no such reading is possible
    implausible: bool
    explanations: tuple[str, ...] = ()  # possible mistakes, likeliest first
    corrected: Array | None = None  # (k,) value in the corrected unit; None: no unit error


NOT_CHECKED = Verdict(float("nan"), float("nan"), False)


class ReadingCheck:
    """Checks each reading of one session as soon as it is taken."""

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
    def compares_readings(self) -> bool:
        """Return whether two readings of one pose can be compared."""
        return not make_observable(self._kind, **self._options).closes

    def check(self, before: Readings, new: Readings, typed: bool, typed_joints: bool) -> Verdict:
        """Check one new reading (Readings of one row) against those before it.

        ``typed``: its value was typed by hand; ``typed_joints``: its joint angles were.
        """
        same = before[(before.station == new.station[0]) & (before.target == new.target[0])]
        fit = self._fit(same, new)
        if fit is None:  # too few readings to locate the instrument
            return self._check_first(same, new)
        deviation, limit, implausible = fit.compare(new)
        if not implausible:
            return Verdict(deviation, limit, False)
        explanations, corrected = self._explanations(fit, new, typed, typed_joints)
        return Verdict(deviation, limit, True, tuple(explanations), corrected)

    def _check_first(self, before: Readings, new: Readings) -> Verdict:
        """Check one of the first readings by range and by the distances to those before it."""
        tcp = np.concatenate([self.poses(before).position, self.poses(new).position])
        result = check_without_fit(before, new, tcp)
        if result is None:
            return NOT_CHECKED
        explanations = [*result.explanations]
        corrected: Array | None = None
        for factor, explanation in UNIT_ERRORS.items():
            value = new.value.copy()
            value[:, :3] *= factor
            if check_without_fit(before, replace(new, value=value), tcp) is None and len(before):
                explanations.append(explanation)
                corrected = value[0]
        if not len(before):
            explanations.append("is the unit right?")
        return replace(result, explanations=tuple(explanations), corrected=corrected)

    def shift(self, old: Readings, new: Readings, before: Readings) -> Array:
        """Return the change (k,) of a pose's reading, m, in base axes once there is a fit.

        ``before``: good readings for the fit, by which the motion of the arm is subtracted.
        """
        same = before[(before.station == old.station[0]) & (before.target == old.target[0])]
        fit = self._fit(same, old)
        if fit is None:
            return np.asarray((new.value - old.value)[0, :3])
        return fit.gap(new)[:3] - fit.gap(old)[:3]

    def poses(self, readings: Readings) -> Poses:
        """Return the TCP poses of some readings by the cell's model, in base."""
        return self._model.predict(readings.q, readings.loads)

    def _fit(self, before: Readings, new: Readings) -> ReadingFit | None:
        """Return the fit to the readings ``before``; None if they are too few or it fails."""
        registered = self._metrology.registered and int(new.station[0]) == 0
        before, new = at_single_place(before), at_single_place(new)
        observable = make_observable(self._kind, registered=registered, **self._options)
        layout = observable.layout(before if len(before) else new)
        needed = layout.size + REDUNDANCY.get(self._kind, 0)
        few = len(before) * observable.equations <= needed
        if observable.closes or (few and layout.size):
            return None
        if registered not in self._parameters:
            self._parameters[registered] = Parameters.of_effects(self._model, self._effects)
        parameters = self._parameters[registered]
        with contextlib.suppress(GapbridgeError):
            return fit_readings(before, new, parameters, observable, self._sigma)
        return None

    def _explanations(
        self, fit: ReadingFit, new: Readings, typed: bool, typed_joints: bool
    ) -> tuple[list[str], Array | None]:
        explanations: list[str] = []
        corrected: Array | None = None
        value = new.value[0]
        for factor, explanation in UNIT_ERRORS.items():
            changed = value.copy()
            changed[:3] *= factor
            if fit.fits(replace(new, value=changed[None])):
                explanations.append(explanation)
                corrected = changed
        for other, explanation in self._axis_variants(value) if typed or len(value) >= 3 else ():
            if fit.fits(replace(new, value=other[None])):
                explanations.append(explanation)
        if typed and not explanations:
            explanations += [
                _coordinate_text(new, i, expected) for i, expected in fit.single_coordinates(new)
            ]
        explanations += self._load_explanations(fit, new)
        if typed_joints and not explanations:
            explanations += [_joint_text(new, i, angle) for i, angle in fit.single_joints(new)]
        return explanations, corrected

    @staticmethod
    def _axis_variants(value: Array) -> Iterator[tuple[Array, str]]:
        """Yield the value with axes exchanged or one sign inverted, and the explanation."""
        if len(value) < 3:
            return
        for order in AXIS_ORDERS:
            changed = value.copy()
            changed[:3] = value[list(order)]
            yield changed, f"it fits with its axes in the order {' '.join(AXES[i] for i in order)}"
        for i in range(3):
            changed = value.copy()
            changed[i] *= -1
            yield changed, f"it fits with the sign of {AXES[i]} inverted"

    def _load_explanations(self, fit: ReadingFit, new: Readings) -> list[str]:
        explanations = []
        for number, load in enumerate((*self._loads, Payload(0.0, name="nothing at all"))):
            if number == int(new.load[0]):
                continue
            loads = replace(
                new.loads, payload_mass=np.array([load.mass]), payload_cog=np.array([load.cog])
            )
            if fit.fits(replace(new, loads=loads)):
                name = load.name or f"{load.mass:g} kg"
                explanations.append(f"it fits if {name} hangs on the flange")
        return explanations


def _coordinate_text(new: Readings, i: int, expected: float) -> str:
    return (
        f"{AXES[i]} alone is off: {new.value[0, i] * 1e3:.3f} mm where about "
        f"{expected * 1e3:.1f} mm was expected; mistyped?"
    )


def _joint_text(new: Readings, i: int, angle: float) -> str:
    return (
        f"it fits if joint {i + 1} stands at {np.degrees(angle):.2f}° instead of "
        f"{np.degrees(new.q[0, i]):.2f}°"
    )


def check_without_fit(before: Readings, new: Readings, tcp: Array) -> Verdict | None:
    """Check one new reading by range and by the readings ``before``; None: plausible.

    ``tcp`` (N + 1, 3) m, in base: of the cell's model, at the N readings before and the new one.
    """
    if new.kind not in RANGES:
        return None
    value = new.value[0, :3]
    distance = float(np.linalg.norm(value))
    low, high, what = RANGES[new.kind]
    if not low <= distance <= high:
        side, limit = ("at least", low) if distance < low else ("at most", high)
        explanation = f"{1e3 * distance:.3f} mm {what}, expected {side} {1e3 * limit:.0f} mm"
        return Verdict(abs(distance - limit), 0.0, True, (explanation,))
    for earlier, place in zip(before.value[:, :3], tcp, strict=False):
        apart = float(np.linalg.norm(value - earlier))
        moved = float(np.linalg.norm(tcp[-1] - place))
        limit = TOLERANCE + RELATIVE_TOLERANCE * moved
        joints = f"the joints put the two {1e3 * moved:.0f} mm apart"
        if new.kind == "relative":
            known = float(np.linalg.norm(earlier))
            off, limit = abs(distance - known), BALL_TOLERANCE + RELATIVE_BALL_TOLERANCE * known
            explanation = (
                f"the balls are {1e3 * distance:.1f} mm apart, {1e3 * known:.1f} mm before"
            )
        elif new.kind == "distance":  # changes by no more than the target moves
            off, limit = apart, moved + limit
            explanation = f"it differs by {1e3 * apart:.1f} mm from an earlier reading; {joints}"
        else:
            off = abs(apart - moved)
            explanation = f"it is {1e3 * apart:.1f} mm from an earlier reading here; {joints}"
        if off > limit:
            return Verdict(off, limit, True, (explanation,))
    return None
