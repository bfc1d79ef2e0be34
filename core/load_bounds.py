"""Plausibility bounds of live loads, from an arm's rated payload."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.model import Model

PAYLOAD_FACTOR = 1.5  # times the rated payload
FORCE_FACTOR = 5.0  # times the weight of the rated payload: process forces
LEVER = 0.3  # m, of that force, or of the heaviest payload, from the flange
MASS_SHARE = 0.5  # of the links' mass, as the rated payload where it is unknown
DEFAULT_RATED = 10.0  # kg, rated payload where the links' masses are unknown too
GRAVITY = 9.80665  # m/s^2
MAX_FORCE, MAX_MOMENT = 1e4, 1e4  # N, Nm on a tool: no arm is pushed harder
WRENCH = (MAX_FORCE,) * 3 + (MAX_MOMENT,) * 3
NEGATIVE_SHARE = 0.1  # of the rated payload, by which an estimated load may be below zero


@dataclass(frozen=True)
class LoadBounds:
    """Bounds of live loads, from the payload that an arm is rated for, kg."""

    rated: float

    @classmethod
    def of(cls, model: Model) -> LoadBounds:
        """Return the bounds of a model's arm.

        Where its rated payload is not known (DH rows or a URDF without ``robot.rated_payload``),
        half the mass of its links is used, or ``DEFAULT_RATED`` if that is unknown too, and at
        least the payload that the cell declares.
        """
        if np.isfinite(model.arm.payload):
            return cls(float(model.arm.payload))
        by_mass = MASS_SHARE * float(np.sum(model.arm.mass))
        return cls(max(by_mass if by_mass > 0.0 else DEFAULT_RATED, float(model.payload_mass)))

    @property
    def least(self) -> float:
        """Return the least payload with what effects add to it, kg: estimates may be below zero."""
        return -NEGATIVE_SHARE * self.rated

    @property
    def mass(self) -> float:
        """Return the heaviest payload, kg."""
        return PAYLOAD_FACTOR * self.rated

    @property
    def force(self) -> float:
        """Return the largest force on the tool, N."""
        return FORCE_FACTOR * GRAVITY * self.rated

    @property
    def torque(self) -> float:
        """Return the largest torque on the tool, Nm."""
        return LEVER * self.force

    def payload_problem(self, mass: float, cog: Array) -> str | None:
        """Return the error message of a payload (kg; (3,) m, flange frame); None: plausible."""
        if not 0.0 <= mass <= self.mass:  # NaN is not
            return f"payload: found {mass:g} kg, expected 0 to {self.mass:g} kg ({self._basis})"
        moment, limit = mass * math.hypot(*cog.tolist()), LEVER * self.mass
        if not moment <= limit:
            return (
                f"payload_cog: found {mass:g} kg at {np.linalg.norm(cog):.3g} m ({moment:.3g} kg "
                f"m), expected at most {limit:.3g} kg m ({self._basis})"
            )
        return None

    def wrench_problem(self, wrench: Array) -> str | None:
        """Return the error message of a wrench on the tool (6,) N, Nm; None: plausible."""
        numbers = wrench.tolist()
        force, torque = math.hypot(*numbers[:3]), math.hypot(*numbers[3:])
        if not force <= self.force:
            return (
                f"force: found {force:.4g} N, expected at most {self.force:.4g} N ({self._basis})"
            )
        if not torque <= self.torque:
            return (
                f"torque: found {torque:.4g} Nm, expected at most {self.torque:.4g} Nm "
                f"({self._basis})"
            )
        return None

    @property
    def _basis(self) -> str:
        return f"rated payload {self.rated:g} kg"
