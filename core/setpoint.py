"""What goes to a controller: one offset-corrected setpoint."""

from __future__ import annotations

from typing import NamedTuple

from gapbridge.core.arrays import Array


class Setpoint(NamedTuple):
    """One corrected joint setpoint, as it leaves the limiter.

    ``offset_in_base`` is the same correction seen at the rigid arm's TCP: where ``q`` puts it minus
    where ``nominal_q`` puts it, position (m) and rotation vector (rad) in base axes. Drivers whose
    controller takes a Cartesian offset send it instead of ``q``. A tuple, as RobotState is.
    """

    q: Array  # (n,) rad, the setpoint to be commanded
    nominal_q: Array  # (n,) rad, what was wanted before correction
    offset_in_base: Array  # (6,) m, rad
    state_timestamp: float  # s, controller clock of the state behind this setpoint
    state_received: float  # s, time.monotonic() when that state was first seen here
