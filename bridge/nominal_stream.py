"""The nominal setpoints as they are used: followed while the source gives them, braked after."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
DECELERATION = 8.0  # rad/s^2 of the fastest joint
SMOOTHING = 0.02  # s: over which the velocity is averaged


class NominalStream:
    """Remembers where the nominal setpoint is and how fast it goes, so that it can stop smoothly.

    A source that dries up in the middle of a motion must not stop the arm dead: joints brake along
    their way, the fastest with DECELERATION.
    """

    def __init__(self, velocity_limit: Vector) -> None:
        self._limit = velocity_limit
        self.q = np.zeros_like(velocity_limit)
        self._rate = np.zeros_like(velocity_limit)

    def start(self, q: Vector) -> None:
        """Begin at rest at ``q`` (n,) rad."""
        self.q = q.copy()
        self._rate[:] = 0.0

    def follow(self, q: Vector, gap: float) -> Vector:
        """Take the source's setpoint (n,), ``gap`` s after the last one."""
        rate = np.clip((q - self.q) / gap, -self._limit, self._limit)
        self._rate += min(gap / SMOOTHING, 1.0) * (rate - self._rate)
        self.q = q.copy()
        return self.q

    def brake(self, gap: float) -> Vector:
        """Return the setpoint ``gap`` s later on the way to rest."""
        fastest = float(np.abs(self._rate).max())
        if fastest > 0.0:
            left = max(fastest - DECELERATION * gap, 0.0)
            after = self._rate * (left / fastest)
            self.q = self.q + 0.5 * gap * (self._rate + after)
            self._rate = after
        return self.q

    @property
    def rests(self) -> bool:
        """Return whether it has come to rest."""
        return not self._rate.any()
