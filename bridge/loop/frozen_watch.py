"""Values that stand still while the clock goes on: a server that repeats its last reading."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.state import RobotState

Vector = NDArray[np.float64]
STILL = 1.0  # s for which joints may be the same to the last bit while they should move
AWAY = 2e-3  # rad: the command has come this far meanwhile
TURNING = 0.02  # rad/s: or a joint says that it turns this fast


class FrozenWatch:
    """Watches the joints; an arm at rest under a command at rest is not frozen."""

    def __init__(self) -> None:
        self._q: Vector | None = None
        self._since = 0.0  # s, controller clock
        self._target: Vector | None = None  # commanded when the joints were last seen to move
        self._turning = 0.0  # s, controller clock: since when the velocity says so

    def update(self, state: RobotState, commanded: Vector) -> str | None:
        """Return in words that the values are frozen, None where they are not."""
        q, now = state.actual_q, state.timestamp
        if self._q is None or now < self._since or not np.array_equal(q, self._q):
            self._q, self._since, self._turning = q.copy(), now, now
            self._target = commanded.copy()
            return None
        if now - self._since < STILL:
            return None
        assert self._target is not None
        away = float(np.abs(commanded - self._target).max())
        turning = float(np.abs(state.actual_qd).max())
        if away < AWAY and turning < TURNING:
            return None
        return (
            f"joints are the same to the last bit for {now - self._since:.2f} s, while the command "
            f"went {away:.4f} rad and they are said to turn at {turning:.3f} rad/s"
        )
