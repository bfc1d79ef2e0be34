"""The present loads on the arm, for the model, from the stream of states."""

from __future__ import annotations

import math

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.load_bounds import LoadBounds
from gapbridge.core.loads import Loads
from gapbridge.core.state import RobotState

MOVED = 1e-5  # rad: smallest commanded motion that determines a joint's direction of approach
MEASURED_MOVED = 2e-3  # rad: the same of encoders, at rest up to a coarse count (1.5e-3) of noise


class LiveLoads:
    """Keeps one row of loads up to date: filtered force, payload, temperature, last motion.

    The controller's declared payload replaces the model's, because the controller subtracts it from
    its TCP force. If a load is beyond ``bounds``, none of that state's is used: the last ones are
    held, and ``problem`` says why. Motion is that of commanded joints without our offset: encoders
    count only where nothing else is known, since their noise would reverse an arm at rest.
    """

    def __init__(
        self, n: int, use_force: bool, time_constant: float, bounds: LoadBounds | None = None
    ) -> None:
        self._bounds = bounds or LoadBounds(math.inf)
        self._has_payload = False  # the last valid state had a payload
        self.problem: str | None = None  # why a load of the last state is implausible
        self._use_force = use_force
        self._constant = time_constant
        self._wrench = np.zeros((1, 6))
        self._mass = np.zeros(1)
        self._cog = np.zeros((1, 3))
        self._temperature = np.zeros((1, n))
        self._approach = np.zeros((1, n))
        self._q_at_motion = np.zeros(n)
        self._followed = ""  # which joints the last motion was of
        self._last = -math.inf  # s, controller clock

    def update(
        self, state: RobotState, own_q: Array | None = None, sent_q: Array | None = None
    ) -> Loads:
        """Return the loads (one row) of this state; the arrays are reused by the next call.

        ``own_q`` (n,) rad: the robot's own target joints; None: unknown. ``sent_q`` (n,) rad: the
        nominal joints of the last setpoint; None: nothing is being written.
        """
        self.problem = self._problem(state)
        if self.problem is None:
            self._take_payload(state)
            self._filter_force(state)
        if sent_q is not None:
            self._follow_motion(sent_q, "sent", MOVED)
        elif own_q is None or (own_q == state.actual_q).all():  # a link without targets
            self._follow_motion(state.actual_q, "measured", MEASURED_MOVED)
        else:
            self._follow_motion(own_q, "own", MOVED)
        has_payload = self._has_payload
        if state.joint_temperatures is not None:
            self._temperature[0] = state.joint_temperatures
        return Loads(
            payload_mass=self._mass if has_payload else None,
            payload_cog=self._cog if has_payload else None,
            wrench=self._wrench if self._use_force else None,
            temperature=None if state.joint_temperatures is None else self._temperature,
            approach=self._approach,
        )

    def _problem(self, state: RobotState) -> str | None:
        """Return which load of a state is implausible, as text; None: none is.

        Payload and force belong together: the controller subtracts one from the other.
        """
        problem = None
        if state.payload is not None and state.payload_cog is not None:
            problem = self._bounds.payload_problem(state.payload, state.payload_cog)
        if problem is None and self._use_force and not _has_no_force(state):
            problem = self._bounds.wrench_problem(state.actual_TCP_force)
        return problem

    def _take_payload(self, state: RobotState) -> None:
        """Store the declared payload, if there is one; a change restarts the force filter.

        From then on the controller subtracts another weight, which the filtered force still holds:
        for the filter's time the model would bend under both, or under neither.
        """
        before = self._has_payload, self._mass[0], *self._cog[0].tolist()
        self._has_payload = state.payload is not None and state.payload_cog is not None
        if self._has_payload:
            self._mass[0] = state.payload
            self._cog[0] = state.payload_cog
        if before != (self._has_payload, self._mass[0], *self._cog[0].tolist()):
            self.reset()

    def reset(self) -> None:
        """Restart the force filter after a gap."""
        self._last = -math.inf

    def _filter_force(self, state: RobotState) -> None:
        """Low-pass the force, so that its noise does not move the arm; restart after a gap.

        A lost sensor counts as zero force; the limiter makes the transition smooth.
        """
        if _has_no_force(state):
            self._wrench[0], self._last = 0.0, -math.inf
            return
        gap = state.timestamp - self._last
        self._last = state.timestamp
        if self._constant <= 0.0 or not 0.0 < gap < 10.0 * self._constant:
            self._wrench[0] = state.actual_TCP_force
            return
        share = 1.0 - math.exp(-gap / self._constant)
        self._wrench[0] += share * (state.actual_TCP_force - self._wrench[0])

    def _follow_motion(self, q: Array, which: str, least: float) -> None:
        """Store the signs of motions of at least ``least`` rad; from other joints on, begin anew.

        Those differ by our offset or by what the servos are behind, which is no motion.
        """
        before = self._q_at_motion
        if which != self._followed:
            self._followed, before[:] = which, q
            return
        step = q - before
        moved = np.abs(step) > least
        if moved.any():
            self._approach[0, moved] = np.sign(step[moved])
            before[moved] = q[moved]


def _has_no_force(state: RobotState) -> bool:
    """Return whether the lost sensor was the only source of the TCP force."""
    return bool(state.sensor_lost) and not np.isfinite(state.actual_TCP_force).all()
