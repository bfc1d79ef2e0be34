"""The nominal setpoints as they are used: followed while the source gives them, braked after."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gapbridge.core.kernels.reference import JIT

Vector = NDArray[np.float64]
DECELERATION = 8.0  # rad/s^2 of the fastest joint
SMOOTHING = 0.02  # s: over which the velocity is averaged
PLACE, RATE, LIMIT = range(3)  # rows of what is kept


@njit(**JIT)
def _followed(kept, given, gap):  # type: ignore[no-untyped-def]
    """Take a setpoint (n,) over: the velocity to it, averaged, and its place."""
    share = min(gap / SMOOTHING, 1.0)
    for i in range(kept.shape[1]):
        most = kept[LIMIT, i]
        rate = min(max((given[i] - kept[PLACE, i]) / gap, -most), most)
        kept[RATE, i] += share * (rate - kept[RATE, i])
        kept[PLACE, i] = given[i]


class NominalStream:
    """Remembers where the nominal setpoint is and how fast it goes, so that it can stop smoothly.

    A source that dries up in the middle of a motion must not stop the arm dead: joints brake along
    their way, the fastest with DECELERATION.
    """

    def __init__(self, velocity_limit: Vector) -> None:
        # one array: each that is handed to compiled code is unwrapped anew in every call
        self._kept = np.zeros((3, len(velocity_limit)))
        self._kept[LIMIT] = velocity_limit
        self.q: Vector = self._kept[PLACE]
        self._rate: Vector = self._kept[RATE]
        _followed(self._kept, self.q.copy(), 1.0)  # compiled now: the loop waits for no compiler

    def start(self, q: Vector) -> None:
        """Begin at rest at ``q`` (n,) rad."""
        self.q[:] = q
        self._rate[:] = 0.0

    def follow(self, q: Vector, gap: float) -> None:
        """Take the source's setpoint (n,), ``gap`` s after the last one."""
        _followed(self._kept, q, gap)

    def brake(self, gap: float) -> Vector:
        """Return the setpoint ``gap`` s later on the way to rest; it holds until the next call."""
        fastest = float(np.abs(self._rate).max())
        if fastest > 0.0:
            left = max(fastest - DECELERATION * gap, 0.0)
            after = self._rate * (left / fastest)
            self.q += 0.5 * gap * (self._rate + after)
            self._rate[:] = after
        return self.q

    @property
    def rests(self) -> bool:
        """Return whether it has converged."""
        return not self._rate.any()
