"""The base of the observables: a reading as a function of arm and instrument.

A member predicts the reading of its instrument for given TCP poses, and the residual of a reading.
Derivatives of the poses by the effects (core.estimation.pose_jacobian) are chained with those of
the reading: the same code for every effect and kind.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.nuisance import Layout, Nuisance
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.errors import ExcitationError
from gapbridge.core.estimation.least_squares import solve
from gapbridge.core.estimation.robust import start_weights
from gapbridge.core.model import Model, Poses
from gapbridge.core.rotation import one_rotation_matrix

STEP = 1e-5  # m and rad, of numerical derivatives by a nuisance
CONVERGED = 1e-9  # m and rad, step size
ROUNDS = 30


class Observable(ABC):
    """One kind of reading. Members are frozen dataclasses with a field ``registered``."""

    kind: ClassVar[str]
    width: ClassVar[int]  # numbers of a reading (Readings.value)
    equations: ClassVar[int]  # numbers in which a reading is compared with its prediction (k)
    frame: ClassVar[tuple[int, ...]]  # components of a place's frame that the readings depend on
    unknown: ClassVar[bool] = False  # the places are unknown, registered or not
    closes: ClassVar[bool] = False  # the arm touches an object: joint angles are the only reading
    first_target: ClassVar[int] = 1  # target 0 is the TCP; from this one on the points are unknown
    registered: bool

    @property
    def sigmas(self) -> Array:
        """Return the noise of each equation (k,) in units of the instrument's sigma (m)."""
        return np.ones(self.equations)

    @property
    def free_length(self) -> bool:
        """Return whether one length a place is unknown."""
        return False

    @abstractmethod
    def gap(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return measured minus predicted (N, k), base axes, for TCP poses of the readings."""

    @abstractmethod
    def reading(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return what the instrument would read (N, width), in its own frame."""

    @abstractmethod
    def initial_nuisance(self, poses: Poses, readings: Readings) -> Nuisance:
        """Return a nuisance to start from, for predicted TCP poses of the readings."""

    def layout(self, readings: Readings) -> Layout:
        """Return which nuisance parameters are unknown in these readings."""
        frame = () if self.registered and not self.unknown else self.frame
        stations = int(readings.station.max(initial=0)) + 1
        return Layout(
            stations, self.targets_of(readings), frame, self.free_length, self.first_target
        )

    def targets_of(self, readings: Readings) -> int:
        """Return how many targets the readings have."""
        return int(readings.target.max(initial=0)) + 1

    def predict(self, model: Model, readings: Readings, nuisance: Nuisance) -> Array:
        """Return what the instrument would read (N, width), in its own frame."""
        return self.reading(model.predict(readings.q, readings.loads), readings, nuisance)

    def residual(self, model: Model, readings: Readings, nuisance: Nuisance) -> Array:
        """Return measured minus predicted (N, k), base axes."""
        return self.gap(model.predict(readings.q, readings.loads), readings, nuisance)

    def columns(
        self,
        parameters: Parameters,
        values: Array,
        readings: Readings,
        nuisance: Nuisance,
        layout: Layout | None = None,
    ) -> tuple[Array, Array]:
        """Return J (N*k, p) and F (N*k, m): residual(new) = residual - J step - F nuisance step.

        ``layout``: that of all readings, where these are some of them.
        """
        moved = parameters.pose_columns(values, readings.q, readings.loads)
        jacobian = self.jacobian(moved.poses, readings, nuisance)
        J = -np.matmul(jacobian, moved.jacobian.transpose(2, 0, 1)).reshape(-1, len(values))
        return J, self.nuisance_columns(moved.poses, readings, nuisance, layout)

    def jacobian(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return d gap / d (TCP translation, rotation) as (N, k, 6), base axes.

        By central differences; overridden where there is a closed form.
        """
        jacobian = np.empty((len(readings), self.equations, 6))
        for axis in range(3):
            shift = np.zeros(3)
            shift[axis] = STEP
            turn = one_rotation_matrix(shift)
            ends = [
                (
                    Poses(poses.position + shift, poses.rotation),
                    Poses(poses.position - shift, poses.rotation),
                ),
                (
                    Poses(poses.position, turn @ poses.rotation),
                    Poses(poses.position, turn.T @ poses.rotation),
                ),
            ]
            for k, (one, other) in enumerate(ends):
                change = self.gap(one, readings, nuisance) - self.gap(other, readings, nuisance)
                jacobian[:, :, 3 * k + axis] = change / (2 * STEP)
        return jacobian

    def nuisance_columns(
        self, poses: Poses, readings: Readings, nuisance: Nuisance, layout: Layout | None = None
    ) -> Array:
        """Return F (N*k, m) for TCP poses of the readings."""
        layout = layout or self.layout(readings)
        F = np.empty((len(readings) * self.equations, layout.size))
        for i in range(layout.size):
            step = np.zeros(layout.size)
            step[i] = STEP
            one = self.gap(poses, readings, nuisance.moved(step, layout))
            other = self.gap(poses, readings, nuisance.moved(-step, layout))
            F[:, i] = (other - one).ravel() / (2 * STEP)
        return F

    def start(self, model: Model, readings: Readings) -> Nuisance:
        """Return the nuisance fitted to the model's predictions, outliers down-weighted.

        Raises ExcitationError where there are too few readings to determine it.
        """
        self._require(readings)
        poses = model.predict(readings.q, readings.loads)
        return self.refined(poses, readings, self.initial_nuisance(poses, readings))

    def refined(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Nuisance:
        """Return the nuisance fitted from a start, outliers down-weighted."""
        layout = self.layout(readings)
        if not layout.size:
            return nuisance
        for _ in range(ROUNDS):
            gap = self.gap(poses, readings, nuisance) / self.sigmas
            root = np.repeat(np.sqrt(start_weights(gap)), self.equations)
            F = self.nuisance_columns(poses, readings, nuisance)
            F = F / np.tile(self.sigmas, len(readings))[:, None]
            step = solve(F * root[:, None], gap.ravel() * root)
            nuisance = nuisance.moved(step, layout)
            if np.abs(step).max() < CONVERGED:
                break
        return nuisance

    def solve_joints(self, model: Model, q: Array, readings: Readings, nuisance: Nuisance) -> Array:
        """Return joints (N, n), rad, near ``q`` at which a reading can be taken; here ``q``."""
        return q

    def target_position(self, poses: Poses, readings: Readings, nuisance: Nuisance) -> Array:
        """Return each reading's target (N, 3), m, base."""
        offset = nuisance.targets[readings.target]
        return np.asarray(poses.position + np.einsum("nij,nj->ni", poses.rotation, offset))

    def _require(self, readings: Readings) -> None:
        if len(readings) and readings.value.shape[1] != self.width:
            raise ExcitationError(
                f"{self.kind} readings: found {readings.value.shape[1]} numbers a reading, "
                f"expected {self.width}"
            )
        layout = self.layout(readings)
        equations, needed = len(readings) * self.equations, layout.size
        if not len(readings) or equations < needed:
            raise ExcitationError(
                f"{self.kind} readings: found {len(readings)}, expected at least "
                f"{max(-(-needed // self.equations), 1)} to know where the instrument stands"
            )
