"""From a nominal setpoint to what may be written: correct, ramp, limit."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from gapbridge.bridge.cell.sections import LimitSettings
from gapbridge.bridge.loop.offset_in_force import InForce
from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.compensation import Compensator, Correction, wanted_pose
from gapbridge.core.errors import LimitError, StaleStateError
from gapbridge.core.kernels.reference import JIT
from gapbridge.core.limits import MAX_GAP_CYCLES, Limiter, Limits
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_vector
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.gate import GateBounds

DECELERATION = 8.0  # rad/s^2 of the fastest joint
LEAST_ROOM = 1e-9  # rad to a joint limit, of which a quotient is taken
SMOOTHING = 0.02  # s: over which the velocity is averaged
POSITION, RATE, LIMIT = range(3)  # rows of NominalStream's array
PEAK_SLOPE = 1.5  # of a smooth step, in units of its mean slope
ARRIVED = 1e-9  # rad from the goal at which a command has reached it
LEAD_IN_SHARE = 0.5  # of the offset's rate limit for the lead-in: the offset changes meanwhile
SOLVED = 1e-5  # m: corrections that miss more of what the joints can reach are not used
DEFAULT_VELOCITY = np.pi  # rad/s: of joints whose limit is not known


def limits_of(settings: LimitSettings, arm: Arm, rate: float) -> Limits:
    """Return the limits of a cell for its arm."""
    known = np.isfinite(arm.limits.velocity)
    velocity = settings.velocity_share * np.where(known, arm.limits.velocity, DEFAULT_VELOCITY)
    if settings.joint_velocity is not None:
        velocity = np.minimum(velocity, settings.joint_velocity)
    return Limits(
        lower=arm.limits.lower + settings.joint_margin,
        upper=arm.limits.upper - settings.joint_margin,
        velocity=velocity,
        offset=settings.offset,
        offset_rotation=settings.offset_rotation,
        offset_rate=settings.offset_rate,
        offset_rotation_rate=settings.offset_rotation_rate,
        joint_offset=settings.joint_offset,
        following=settings.following,
        cycle=1.0 / rate,
    )


def gate_bounds(settings: LimitSettings) -> GateBounds:
    """Return the limits of a cell for the drivers' gate."""
    return GateBounds(
        settings.offset, settings.offset_rotation, settings.offset_rate,
        settings.offset_rotation_rate, settings.joint_offset, settings.joint_velocity,
        settings.velocity_share,
    )  # fmt: skip


def longest_ramp_out(settings: LimitSettings) -> float:
    """Return how long the largest offset takes to ramp out at the cell's rates, s."""
    return max(
        settings.offset / settings.offset_rate,
        settings.offset_rotation / settings.offset_rotation_rate,
    )


@njit(**JIT)
def _track(motion, q, gap):  # type: ignore[no-untyped-def]
    """Update position and averaged velocity with a setpoint (n,), ``gap`` s after the last."""
    share = min(gap / SMOOTHING, 1.0)
    for i in range(motion.shape[1]):
        most = motion[LIMIT, i]
        rate = min(max((q[i] - motion[POSITION, i]) / gap, -most), most)
        motion[RATE, i] += share * (rate - motion[RATE, i])
        motion[POSITION, i] = q[i]


class NominalStream:
    """Tracks position and velocity of the nominal joints reached, so that it can brake smoothly.

    If a source runs dry in the middle of a motion, the joints brake along their path, the fastest
    with DECELERATION, or harder where a joint limit (``lower``, ``upper``: (n,) rad) is nearer.
    """

    def __init__(self, velocity_limit: Array, lower: Array, upper: Array) -> None:
        self._lower, self._upper = lower, upper
        # one array: each argument of compiled code costs time in every call
        self._motion = np.zeros((3, len(velocity_limit)))
        self._motion[LIMIT] = velocity_limit
        self.q: Array = self._motion[POSITION]
        self._rate: Array = self._motion[RATE]
        self._kept = self._motion.copy()
        _track(self._motion, self.q.copy(), 1.0)  # compiles it now: the loop must not wait

    def start(self, q: Array) -> None:
        """Begin at rest at ``q`` (n,) rad."""
        self.q[:] = q
        self._rate[:] = 0.0

    def follow(self, q: Array, gap: float) -> None:
        """Track nominal joints (n,) rad, ``gap`` s after the last ones."""
        _track(self._motion, q, gap)

    def brake(self, gap: float) -> Array:
        """Return the setpoint (n,) ``gap`` s later while braking; valid until the next call."""
        fastest = float(np.abs(self._rate).max())
        if fastest > 0.0:
            speed = max(fastest - self._deceleration(fastest) * gap, 0.0)
            after = self._rate * (speed / fastest)
            self.q += 0.5 * gap * (self._rate + after)
            # the last step takes a whole cycle, and so more room than was left
            np.clip(self.q, self._lower, self._upper, out=self.q)
            self._rate[:] = after
        return self.q

    def _deceleration(self, fastest: float) -> float:
        """Return that of the fastest joint with which each stops before its limit, rad/s^2."""
        rate = self._rate
        room = np.where(rate > 0.0, self._upper - self.q, self.q - self._lower)
        needed = 0.5 * fastest * np.abs(rate) / np.maximum(room, LEAST_ROOM)
        return float(np.max(needed, initial=DECELERATION))

    def keep(self) -> None:
        """Remember the present motion for ``take_back``."""
        self._kept[:] = self._motion

    def take_back(self) -> None:
        """Return to the motion of the last ``keep``."""
        self._motion[:] = self._kept

    @property
    def at_rest(self) -> bool:
        """Return whether it has come to rest."""
        return not self._rate.any()


class SetpointStream:
    """One stream of setpoints from ``start`` until it is at rest."""

    def __init__(self, model: Model, settings: LimitSettings, rate: float, clock: Clock) -> None:
        self._now = clock.monotonic
        limits = limits_of(settings, model.arm, rate)
        self.limiter = Limiter(limits, model.arm.n)
        self._compensator = Compensator(model)
        self._nominal = NominalStream(limits.velocity, limits.lower, limits.upper)
        self._ramp_time = settings.ramp_time
        self._longest_gap = MAX_GAP_CYCLES / rate
        self._ramp = 0.0
        self._resumes = False  # started with an offset in force, from which the ramp continues
        self._last = 0.0  # s, controller time of the last setpoint
        self._start_gap: Array | None = None  # rad: start joints minus the first setpoint
        self._lead_time = 0.0  # s that the lead-in over it takes at least
        self._time_over(np.zeros(model.arm.n))  # compiles it now
        self._since_start = 0.0  # s
        self._kept = (0.0, False, 0.0, 0.0)
        self.residual = 0.0  # m, of the last correction
        self.missed = 0.0  # m of it that the joints could correct
        self._compensator.missed(np.zeros(model.arm.n), Loads(), 0.0)  # compiles it now
        self.finite = True  # the last correction is finite
        self._loads = Loads()  # of the last correction
        self._solved = np.zeros(model.arm.n + 6)  # joint and TCP offset of the last one solved
        self.clamped = 0  # bits of the last setpoint

    def correct(self, nominal_q: Array, loads: Loads) -> Correction:
        """Return the correction alone, neither ramped nor limited."""
        correction = self._compensator.correct(nominal_q, loads)
        self.residual = float(correction.residual)
        self.missed = self.residual
        if not self.residual < SOLVED:
            self.missed = self._compensator.missed(nominal_q, loads, self.residual)
        # lists: for twelve numbers faster than arrays
        numbers = correction.q.tolist() + correction.offset_in_base.tolist()
        self.finite = math.isfinite(sum(numbers))
        self._loads = loads
        return correction

    @property
    def unsolved(self) -> str:
        """Return why the last correction misses the wanted pose, as text; empty: it does not."""
        if self.missed < SOLVED:
            return ""
        loads = self._loads
        mass = self._compensator.model.payload_mass
        if loads.payload_mass is not None:
            mass = float(loads.payload_mass[0])
        force = 0.0 if loads.wrench is None else float(np.linalg.norm(loads.wrench[0, :3]))
        under = f"under a payload of {mass:.3g} kg and a force of {force:.3g} N"
        if not math.isfinite(self.residual):
            return f"the model finds no equilibrium {under}: are compliance and effects right?"
        return (
            f"the corrected setpoint stays {1e3 * self.missed:.3g} mm from the wanted pose "
            f"{under}, expected at most {1e3 * SOLVED:g} mm: a singular pose, or a model that "
            "bends too far"
        )

    def start(
        self, start_q: Array, timestamp: float, led: bool = False, in_force: InForce | None = None
    ) -> Array:
        """Begin at rest at ``start_q`` (n,); returns the nominal joints there. Raises LimitError.

        ``led``: the setpoints that follow need no lead-in from the start joints.
        ``in_force``: an offset that the arm already has; None: none.
        """
        nominal = start_q
        if in_force is None:
            self.limiter.start(start_q)
        else:
            nominal = start_q - in_force.delta
            self.limiter.start(start_q, in_force.delta, in_force.offset_in_base)
        self._nominal.start(nominal)
        self._ramp, self._resumes = 0.0, in_force is not None
        self._solved[:] = 0.0
        self._start_gap, self._since_start = None, np.inf if led else 0.0
        # as if a setpoint had been there one cycle ago
        self._last = timestamp - self.limiter.limits.cycle
        return nominal

    def advance(
        self, state: RobotState, source_q: Array | None, loads: Loads, goal: float,
        expiry: float = np.inf,
    ) -> Setpoint:  # fmt: skip
        """Return the next setpoint; ``source_q`` None: the motion brakes.

        ``goal`` of the ramp: 1 in, 0 out. The setpoint's arrays are valid until the next call.
        Raises LimitError, and StaleStateError after ``expiry`` (s, monotonic): then nothing has
        changed and nothing may be sent.
        """
        self._keep()
        try:
            return self._advance(state, source_q, loads, goal, expiry)
        except (LimitError, StaleStateError):
            self.take_back()
            raise

    def _keep(self) -> None:
        self.limiter.keep()
        self._nominal.keep()
        self._kept = (self._ramp, self._resumes, self._last, self._since_start)

    def take_back(self) -> None:
        """Go on from the setpoint before the last one: the last one is not in force.

        Otherwise the next one could be farther from what is in force than the limits allow at once.
        """
        self.limiter.take_back()
        self._nominal.take_back()
        self._ramp, self._resumes, self._last, self._since_start = self._kept

    def _advance(
        self, state: RobotState, source_q: Array | None, loads: Loads, goal: float, expiry: float
    ) -> Setpoint:
        gap = state.timestamp - self._last
        if gap < 0.0 and goal == 0.0:
            # the clock went back, which has ended the motion: the offset ramps out step by step
            gap = self.limiter.limits.cycle
        usable = min(max(gap, 0.0), self._longest_gap)
        stream = self._nominal
        if source_q is None:
            self.limiter.settle()
            nominal = stream.brake(usable)
        else:
            nominal = self._without_start_gap(source_q, usable)
        correction = self.correct(nominal, loads)
        corrected, offset, n = correction.q, correction.offset_in_base, len(nominal)
        if self.missed < SOLVED:
            self._solved[:n], self._solved[n:] = corrected - nominal, offset
        else:  # the last solved one is ramped out: the loop ends the motion
            corrected, offset = nominal + self._solved[:n], self._solved[n:]
        step, before = usable / self._ramp_time, self._share(offset)
        ramp = min(max(goal, before - step), before + step)
        if self._now() > expiry:
            raise StaleStateError("the state was too old before its setpoint could leave")
        limited = self.limiter.limit(nominal, corrected, offset, ramp, state.actual_q, gap)
        if source_q is not None:
            stream.follow(self.limiter.reached, gap)
            self._since_start += usable
        self._ramp, self._resumes = ramp, False
        self._last, self.clamped = state.timestamp, limited.clamped
        return Setpoint(limited.q, nominal, limited.offset_in_base)

    def _share(self, offset_in_base: Array) -> float:
        """Return the ramp (0..1); at a start with an offset in force, that offset's share.

        The share is by the length of the TCP's translation.
        """
        if not self._resumes:
            return self._ramp
        wanted = float(np.linalg.norm(offset_in_base[:3]))
        present = float(np.linalg.norm(self.limiter.offset_in_base[:3]))
        return min(present / wanted, 1.0) if wanted > 0.0 else 0.0

    @property
    def joint_offset(self) -> Array:
        """Return the joint offset (n,) in the last setpoint, rad: a read-only view."""
        return self.limiter.joint_offset

    def reset_solver(self) -> None:
        """Solve the next correction without a warm start, as after a refused setpoint."""
        self._compensator.reset()

    @property
    def ramp_time(self) -> float:
        """Return the shortest time of a ramp, s."""
        return self._ramp_time

    @property
    def has_no_offset(self) -> bool:
        """Return whether no offset is left."""
        bare = self._ramp == 0.0 and not self._resumes
        return bare and not self.limiter.offset_in_base.any()

    def _without_start_gap(self, source_q: Array, gap: float) -> Array:
        """Return the source's setpoint with the lead-in from the start joints: no jump."""
        if self._start_gap is None:
            self._start_gap = self._nominal.q - source_q
            self._lead_time = self._time_over(source_q)
        share = (self._since_start + gap) / max(self._ramp_time, self._lead_time)
        if share >= 1.0:
            return source_q
        remaining = 1.0 - share * share * (3.0 - 2.0 * share)
        return source_q + remaining * self._start_gap

    def _time_over(self, source_q: Array) -> float:
        """Return the time (s) of the lead-in, slower than the offset's rate limits.

        If an offset remained in the arm, a source that starts at the arm's joints is that far from
        the nominal joints.
        """
        poses = wanted_pose(self._compensator.model, np.stack([self._nominal.q, source_q]))
        away = float(np.linalg.norm(poses.position[1] - poses.position[0]))
        turn = float(np.linalg.norm(rotation_vector(poses.rotation[0].T @ poses.rotation[1])))
        limits = self.limiter.limits
        mean = max(away / limits.offset_rate, turn / limits.offset_rotation_rate)
        return PEAK_SLOPE / LEAD_IN_SHARE * mean

    @property
    def at_rest(self) -> bool:
        """Return whether no offset is left and the motion has come to rest."""
        return self.has_no_offset and self._nominal.at_rest and self.arrived

    @property
    def arrived(self) -> bool:
        """Return whether the command has reached its goal, which the velocity may delay."""
        return self.limiter.lag < ARRIVED

    def shorten_ramp(self, ramp_time: float) -> None:
        """Ramp within ``ramp_time`` s from now on, if it would take longer."""
        self._ramp_time = min(self._ramp_time, ramp_time)

    def end(self) -> None:
        """End the stream; nothing may be sent until the next ``start``."""
        self.limiter.reset()
