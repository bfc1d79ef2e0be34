"""What an arm can carry and bear: beyond that, a live load is a mistake that no model bends for."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.model import Model

HEAVIEST = 1.5  # times the rated payload
STRONGEST = 5.0  # times the weight of the rated payload: what process forces come to
LEVER = 0.3  # m: at which that force, or the heaviest payload, acts beside the flange
OWN_SHARE = 0.5  # of the links' mass: more than any arm of the field is rated for
UNKNOWN = 10.0  # kg: rated payload where not even the links' masses are known
GRAVITY = 9.80665  # m/s^2


@dataclass(frozen=True)
class LoadBounds:
    """Bounds of live loads, from the payload that an arm is rated for, kg."""

    rated: float

    @classmethod
    def of(cls, model: Model) -> LoadBounds:
        """Return the bounds of a model's arm.

        Where its rated payload is not known (DH rows or a URDF without ``robot.rated_payload``),
        half the mass of its links stands instead, ``UNKNOWN`` where that is not known either, and
        at least the payload that the cell declares.
        """
        if np.isfinite(model.arm.payload):
            return cls(float(model.arm.payload))
        own = OWN_SHARE * float(np.sum(model.arm.mass))
        return cls(max(own if own > 0.0 else UNKNOWN, float(model.payload_mass)))

    @property
    def mass(self) -> float:
        """Return the heaviest payload, kg."""
        return HEAVIEST * self.rated

    @property
    def force(self) -> float:
        """Return the strongest pull on the tool, N."""
        return STRONGEST * GRAVITY * self.rated

    @property
    def torque(self) -> float:
        """Return the strongest torque on the tool, Nm."""
        return LEVER * self.force

    def payload_problem(self, mass: float, cog: Array) -> str | None:
        """Return in words why a payload (kg; (3,) m, flange frame) cannot be; None: it can."""
        if not 0.0 <= mass <= self.mass:  # NaN is not
            return f"payload: found {mass:g} kg, expected 0 to {self.mass:g} kg ({self._why})"
        moment, most = mass * math.hypot(*cog.tolist()), LEVER * self.mass
        if not moment <= most:
            return (
                f"payload_cog: found {mass:g} kg at {np.linalg.norm(cog):.3g} m ({moment:.3g} kg "
                f"m), expected at most {most:.3g} kg m ({self._why})"
            )
        return None

    def wrench_problem(self, wrench: Array) -> str | None:
        """Return in words why a pull on the tool (6,) N, Nm cannot be; None: it can."""
        numbers = wrench.tolist()
        force, torque = math.hypot(*numbers[:3]), math.hypot(*numbers[3:])
        if not force <= self.force:
            return f"force: found {force:.4g} N, expected at most {self.force:.4g} N ({self._why})"
        if not torque <= self.torque:
            return (
                f"torque: found {torque:.4g} Nm, expected at most {self.torque:.4g} Nm "
                f"({self._why})"
            )
        return None

    @property
    def _why(self) -> str:
        return f"rated payload {self.rated:g} kg"
