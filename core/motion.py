"""The motion of a log: angles, speeds, accelerations and loads.

A log is either a recording of motion (sampled trajectory) or a list of poses at rest; only the
first has derivatives. Which one it is follows from its timestamps and steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from gapbridge.core.arrays import Array, Index, Mask
from gapbridge.core.derivatives import differentiate, moving_samples
from gapbridge.core.errors import LogError
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding

MAX_SAMPLE_TIME = 0.2  # s between rows beyond which they count as poses at rest
MAX_JOINT_SPEED = 15.0  # rad/s between rows beyond which they count as poses at rest
MIN_SMOOTH_SHARE = 0.5  # share of rows without jumps below which a shorter window is tried
WINDOWS = (0.3, 0.1, 0.05, 0.025)  # s either side at most, tried in turn
GAP = 4.0  # sampling steps without a row that end a stretch
FEWER_JUMPS = 0.5  # times the rows in which the angles' accelerations jump: a Panda's jump in 20 %
COPIES = 0.9  # share of repeated rows alike in every column that makes them copies of one cycle
FEW_REPEATS = 0.01  # share of repeated timestamps that may simply be left out
MOTION = "motion"  # among what is derived of a log once
EDGE = 128  # rows either side that derivatives need
LEAD = 0.5  # s before a row that delays look back to
TURN = 2 * np.pi
WITHIN_TURN = TURN + 0.01  # rad: angles beyond it, in degrees or not, do not wrap
SMALLEST_MOTION = 1e-4  # rad/s, what counts as standing still at least
SPEED_WINDOW = 0.05  # s over which speeds are compared with the way of the angles
MIN_WINDOWS = 20
MIN_SPEED = 0.02  # rad/s rms, from which a joint's speeds are compared
SPEED_SHARE = 0.5, 2.0  # of the angles' change: speeds beyond are none, or have another unit


@dataclass(frozen=True)
class Contributions:
    """Contributions of the rigid arm's parts to torques and wrenches, scaled by effects.

    Torques are those the motors must deliver; wrenches are what the load does to the flange sensor
    (flange axes, about the flange origin).
    """

    link_torque: Array  # (N, n, n) Nm: [:, i, j] of link i+1's mass and inertia at joint j+1
    arm_torque: Array  # (N, n) Nm of all links together
    payload_torque: Array  # (N, n) Nm per kg of payload at its declared centre of gravity
    external_torque: Array  # (N, n) Nm against the pull of the surroundings on the tool
    payload_wrench: Array  # (N, 6) N, Nm per kg of payload at its declared centre of gravity
    external_wrench: Array  # (N, 6) N, Nm of the surroundings
    payload_mass: Array  # (N,) kg, declared
    carried_mass: Array  # (N,) kg, with what the effects at hand add to it
    # torques (N, n) and wrench (N, 6) per kg of payload, its centre shifted by (3,) m, flange axes
    payload_from: Callable[[Array], tuple[Array, Array]]
    # torques (N, n) that a first moment (3,) kg m of a link (from 0) takes more, link axes
    link_from: Callable[[int, Array], Array]


@dataclass(frozen=True)
class Motion:
    """Motion of N rows of a log. Derivatives are zero where the log lists poses at rest."""

    t: Array  # (N,) s; zeros where the log has no timestamps
    q: Array  # (N, n) rad, encoders (or the command where the log has no encoders)
    qd: Array  # (N, n) rad/s
    qdd: Array  # (N, n) rad/s2
    target_q: Array | None  # (N, n) rad
    loads: Loads
    rows: Index  # (N,) row in the log
    valid: Mask  # (N,) False near the ends of a stretch
    stretch: Index  # (N,) number of the stretch without a gap in time
    start: float  # s, the log's first timestamp
    moving: bool  # False: poses at rest
    still: Array  # (n,) rad/s below which the direction of motion is unsure
    pieces: Contributions | None = None
    load: Array | None = None  # (N, n) Nm of the rigid arm with payload and pull, no friction
    held: Array | None = None  # (N, n) Nm that each joint holds at rest: gravity, payload, pull

    @classmethod
    def at_rest(cls, q: Array, loads: Loads) -> Motion:
        """Return N rows of an arm that rests at ``q`` (N, n), rad; without times."""
        count, n = q.shape
        return cls(
            t=np.zeros(count), q=q, qd=np.zeros_like(q), qdd=np.zeros_like(q), target_q=None,
            loads=loads, rows=np.arange(count), valid=np.ones(count, dtype=bool),
            stretch=np.zeros(count, dtype=np.int64), start=0.0, moving=False,
            still=np.full(n, SMALLEST_MOTION),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.t)

    def pick(self, rows: Index | Mask) -> Motion:
        """Return the motion of some of the rows (derivatives stay those of the full rate)."""
        index: Any = rows
        return replace(
            self, t=self.t[rows], q=self.q[rows], qd=self.qd[rows], qdd=self.qdd[rows],
            target_q=None if self.target_q is None else self.target_q[rows],
            loads=self.loads[index], rows=self.rows[rows], valid=self.valid[rows],
            stretch=self.stretch[rows], pieces=None,
            held=None if self.held is None else self.held[rows],
        )  # fmt: skip

    def stretches(self) -> list[slice]:
        """Return the rows of each stretch without a gap in time."""
        cuts = np.flatnonzero(np.diff(self.stretch)) + 1
        return [slice(a, b) for a, b in pairwise([0, *(int(c) for c in cuts), len(self)])]

    @property
    def recorded_time(self) -> Array:
        """Return the time (N,) from the first row on, pauses between stretches left out, s."""
        steps = np.diff(self.t)
        steps = np.where(np.diff(self.stretch) > 0, 0.0, steps)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def direction(self) -> Array:
        """Return the sign of motion (N, n), smooth within the speeds at which it is unsure."""
        return np.column_stack([self.direction_of(j) for j in range(self.qd.shape[1])])

    def direction_of(self, joint: int) -> Array:
        """Return the ``direction`` (N,) of one joint (from 0)."""
        return np.asarray(np.tanh(4.0 * self.qd[:, joint] / self.still[joint]))

    @property
    def turning(self) -> Mask:
        """Return where (N, n) a joint that moves in this log is at rest or reverses."""
        moves = np.abs(self.qd).max(axis=0, initial=0.0) > 3 * self.still
        return np.asarray(moves & (np.abs(self.qd) < self.still))


def motion_of(log: Log) -> Motion:
    """Return the motion of a log.

    Needs ``actual_q`` or ``target_q``; speeds come from ``actual_qd`` where the log has them.
    Angles that jump by whole turns run on (``without_turns``).
    A cycle that was recorded twice counts once; timestamps rounded so far that they repeat are
    replaced by an even clock if they fit one (``time_finding`` reports). Raises LogError naming the
    row where time runs backwards or repeats in any other way.
    """
    cached: Motion | None = log.derived.get(MOTION)
    if cached is None:
        cached = log.derived[MOTION] = _motion_of(log)
    return cached


def with_motion(log: Log, motion: Motion) -> Log:
    """Return the log with a motion that was derived with the rows before and after."""
    log.derived[MOTION] = motion
    return log


def without_turns(log: Log) -> Log:
    """Return the log with angles that run on where they jump by whole turns.

    Encoders may report -pi to pi. Only recordings of motion run on: poses at rest may lie half a
    turn apart. A joint that ran on has the middle of its range within half a turn of zero, so that
    it stays within its limits. Commands are moved onto the turn of the encoders, also for poses.
    ``turned`` of the log names the joints that were changed.
    """
    angles = {n: log.columns[n] for n in ("actual_q", "target_q") if log.has(n)}
    if not angles or not all(np.isfinite(q).all() for q in angles.values()):
        return log
    wraps = np.min([np.abs(q).max(axis=0) for q in angles.values()], axis=0) < WITHIN_TURN
    first, *others = angles
    turns = {first: np.where(wraps, _turns_passed(log, angles[first]), 0.0)}
    q = angles[first] + TURN * turns[first]
    for name in others:
        turns[name] = np.where(wraps, np.round((q - angles[name]) / TURN), 0.0)
    turned = np.any([t.any(axis=0) for t in turns.values()], axis=0)
    if not turned.any():
        return log
    columns = {name: angles[name] + TURN * turns[name] for name in angles}
    joints = tuple((np.flatnonzero(turned) + 1).tolist())
    return replace(log, columns={**log.columns, **columns}, turned=joints)


def _turns_passed(log: Log, q: Array) -> Array:
    """Return the turns (N, n) to add to the angles of a log; zeros for poses at rest."""
    turns, time = np.zeros(q.shape), log.get("timestamp")
    if time is None or not np.isfinite(time).all():
        return turns
    session = log.columns["session"] if log.session_names else np.zeros(len(q))
    for s in np.unique(session):
        rows = np.flatnonzero(session == s)
        own, step = q[rows], np.diff(q[rows], axis=0)
        # within a pause of the recording a joint may have gone as far as that
        fastest = MAX_JOINT_SPEED * np.diff(time[rows])[:, None]
        jumps = np.abs(step) > np.maximum(fastest, TURN / 2)
        speed = log.columns["actual_qd"][rows] if log.has("actual_qd") else None
        if not jumps.any() or not is_moving(time[rows], own, speed):
            continue
        passed = np.zeros(own.shape)
        passed[1:] = -np.cumsum(np.where(jumps, np.round(step / TURN), 0.0), axis=0)
        run_on = own + TURN * passed
        middle = np.round((run_on.max(axis=0) + run_on.min(axis=0)) / 2 / TURN)
        turns[rows] = np.where(jumps.any(axis=0), passed - middle, 0.0)
    return turns


def without_wrong_speeds(log: Log) -> Log:
    """Return the log without ``actual_qd`` where the angles of a recording contradict it.

    Some recorders write zeros, degrees per second or a motor's speeds. ``wrong_speeds`` of the log
    names the joints, and how many times the speeds are what they should be.
    """
    time, q, speed = (log.get(name) for name in ("timestamp", "actual_q", "actual_qd"))
    if time is None or q is None or speed is None or len(time) < MIN_WINDOWS:
        return log
    if not np.isfinite(np.column_stack([time, q, speed])).all() or (np.diff(time) < 0).any():
        return log  # refused where it is used
    rows, t, _ = _clock(log, time)
    step = float(np.median(np.diff(t)))
    if not 0 < step <= MAX_SAMPLE_TIME:
        return log
    width = max(round(SPEED_WINDOW / step), 1)
    mean = (speed[rows][1:] + speed[rows][:-1]) / 2
    travelled = np.vstack([0 * q[:1], np.cumsum(mean * np.diff(t)[:, None], axis=0)])[::width]
    took = np.diff(t[::width])
    whole = (took > 0) & (took < 2 * width * step)  # no pause
    way, travelled = np.diff(q[rows][::width], axis=0)[whole], np.diff(travelled, axis=0)[whole]
    if len(way) < MIN_WINDOWS:
        return log
    square = np.maximum((way**2).sum(axis=0), 1e-300)
    share = (way * travelled).sum(axis=0) / square
    # poses at rest that were given times jump to and fro
    moves = np.sqrt(square / len(way)) > MIN_SPEED * width * step
    smooth = (np.diff(way, axis=0) ** 2).sum(axis=0) < square
    wrong = moves & smooth & ((share < SPEED_SHARE[0]) | (share > SPEED_SHARE[1]))
    if not wrong.any():
        return log
    columns = {name: values for name, values in log.columns.items() if name != "actual_qd"}
    joints = tuple((np.flatnonzero(wrong) + 1).tolist())
    return replace(log, columns=columns, wrong_speeds=(joints, float(np.median(share[wrong]))))


def _motion_of(log: Log) -> Motion:
    log = without_wrong_speeds(without_turns(log))
    q = log.require("actual_q", "target_q")
    time = log.require("timestamp") if log.has("timestamp") else None
    rows: Any = np.arange(len(q))
    t = np.zeros(len(q)) if time is None else time
    moving = time is not None and is_moving(time, q, log.get("actual_qd"))
    if time is not None:
        check_order(log, time)
        if moving:
            rows, t, finding = _clock(log, time)
            if finding is not None and finding.check is LogCheck.AMBIGUOUS_TIME:
                line, first, repeated, count = finding.values
                raise LogError(
                    f"{log.path}: row {line}, column timestamp: found {first:g} again (as in "
                    f"{repeated} of {count} rows), expected a time of its own per row"
                )
    measured_qd = log.require("actual_qd")[rows] if log.has("actual_qd") else None
    target = log.require("target_q")[rows] if log.has("target_q") else None
    motion = replace(
        Motion.at_rest(q[rows], log.loads()[rows]),
        t=t, target_q=target, rows=rows, start=float(t[0]), moving=moving,
    )  # fmt: skip
    if measured_qd is not None:
        motion = replace(motion, qd=measured_qd)
    session = log.columns["session"][rows] if log.session_names else np.zeros(len(rows))
    return _with_derivatives(motion, measured_qd, np.diff(session) != 0) if moving else motion


def is_moving(time: Array, q: Array, speed: Array | None = None) -> bool:
    """Return whether rows sample a motion (True) or list poses at rest (False)."""
    steps = np.diff(time)
    advancing = steps > 0
    if len(time) < 20 or advancing.sum() < 10 or np.median(steps[advancing]) > MAX_SAMPLE_TIME:
        return False
    jump = np.abs(np.diff(q, axis=0)).max(axis=1)[advancing] / steps[advancing]
    if np.median(jump) > MAX_JOINT_SPEED:
        return False
    # speeds of zero between poses that differ: each row was taken at rest
    at_rest = speed is not None and float(np.abs(speed).max()) < SMALLEST_MOTION
    return not (at_rest and float(np.median(jump)) > 0.01)


def time_stretches(log: Log, count: int) -> Index | None:
    """Return the number (N,) of each row's stretch of time, ``count`` even ones of a recording.

    Pauses are left out. Neighbours in time share their errors, as repeats of a pose do. None for
    poses at rest, and where rows are not in time order.
    """
    time, q = log.get("timestamp"), log.get("actual_q", "target_q")
    if time is None or q is None or not (np.diff(time) >= 0).all():
        return None
    if not is_moving(time, q, log.get("actual_qd")):
        return None
    step = np.diff(time)
    recorded = np.append(0.0, np.cumsum(np.where(step > GAP * np.median(step), 0.0, step)))
    number = recorded / max(float(recorded[-1]), 1e-9) * count
    return np.asarray(np.minimum(number.astype(np.int64), count - 1))


def time_finding(log: Log) -> LogFinding | None:
    """Return the finding on repeated timestamps of a moving log; or None."""
    time, q = log.get("timestamp"), log.get("actual_q")
    if time is None or q is None or not is_moving(time, q, log.get("actual_qd")):
        return None
    return _clock(log, time)[2]


def check_order(log: Log, time: Array) -> None:
    """Raise LogError where timestamps (N,) run backwards."""
    backwards = np.flatnonzero(np.diff(time) < 0)
    if len(backwards):
        row = int(backwards[0]) + 1
        raise LogError(
            f"{log.path}: row {log.line(row)}, column timestamp: found {time[row]:g} after "
            f"{time[row - 1]:g}, expected rows in time order"
        )


def _clock(log: Log, time: Array) -> tuple[Index, Array, LogFinding | None]:
    """Return the rows of a recording that count, their times, and how its clock repeats."""
    repeated = np.flatnonzero(np.diff(time) <= 0) + 1
    all_rows: Index = np.arange(len(time))
    if not len(repeated):
        return all_rows, time, None
    count, first = len(repeated), log.line(repeated[0])
    identical = np.ones(count, dtype=bool)
    for column in log.columns.values():
        flat = column.reshape(len(column), -1)
        same = flat[repeated] == flat[repeated - 1]
        empty = np.isnan(flat[repeated]) & np.isnan(flat[repeated - 1])
        identical &= (same | empty).all(axis=1)
    if identical.mean() >= COPIES or count < FEW_REPEATS * len(time):
        kept = np.delete(all_rows, repeated)
        return kept, time[kept], LogFinding(LogCheck.COPIED_ROWS, (count, len(time), first))
    uniform: Array = np.asarray(np.polyval(np.polyfit(all_rows, time, 1), all_rows), dtype=float)
    resolution = float(np.diff(time)[np.diff(time) > 0].min())
    if np.abs(time - uniform).max() <= resolution:
        return all_rows, uniform, LogFinding(LogCheck.ROUNDED_TIME, (resolution, count, first))
    values = first, float(time[repeated[0]]), count, len(time)
    return all_rows, time, LogFinding(LogCheck.AMBIGUOUS_TIME, values)


def _with_derivatives(motion: Motion, measured_qd: Array | None, new_session: Mask) -> Motion:
    steps = np.diff(motion.t)
    step = float(np.median(steps))
    stretch = np.concatenate([[0], np.cumsum((steps > GAP * step) | new_session)])
    # a gap shorter than the shortest window is interpolated (a Panda's of 10 to 20 ms); a delayed
    # command is not known in it, so that it ends a stretch all the same
    ends = (steps > max(GAP * step, WINDOWS[-1])) | new_session
    smooth = np.concatenate([[0], np.cumsum(ends)])
    qd, qdd = np.zeros_like(motion.q), np.zeros_like(motion.q)
    valid, noise = np.zeros(len(motion), dtype=bool), np.zeros(motion.q.shape[1])
    for number in range(int(smooth[-1]) + 1):
        part = np.flatnonzero(smooth == number)
        if len(part) < 15:
            continue
        result = _derivatives(
            motion.t[part], step, motion.q[part], None if measured_qd is None else measured_qd[part]
        )
        qd[part], qdd[part], valid[part], noise_here = result
        noise = np.maximum(noise, noise_here)
    peak = np.abs(qd[valid]).max(axis=0) if valid.any() else np.zeros(motion.q.shape[1])
    still = np.maximum(np.maximum(5 * noise, 0.02 * peak), SMALLEST_MOTION)
    return replace(motion, qd=qd, qdd=qdd, valid=valid, stretch=stretch, still=still)


def _interpolated(time: Array, value: Array, at: Array) -> Array:
    """Return signals (N, k) at other times (M,) by cubic splines."""
    from gapbridge.core.kernels.interpolation import splined  # brings numba

    return np.stack([splined(time, column, at) for column in value.T], axis=1)


def _derivatives(
    t: Array, step: float, q: Array, measured_qd: Array | None
) -> tuple[Array, Array, Mask, Array]:
    """Return speeds, accelerations, the rows where they are good, and noise of the speeds (n,)."""
    grid = np.linspace(t[0], t[-1], max(round((t[-1] - t[0]) / step), 14) + 1)
    uniform = len(grid) == len(t) and bool(np.abs(grid - t).max() < 1e-2 * step)
    step = float(grid[1] - grid[0])
    on_grid = q if uniform else _interpolated(t, q, grid)
    cached = measured_qd if uniform or measured_qd is None else _interpolated(t, measured_qd, grid)
    moves = moving_samples(on_grid, step)
    speed = differentiate(on_grid, step, 1, moves=moves)
    for longest in WINDOWS:
        qdd, unsure, edge = _accelerations(on_grid, cached, step, longest, moves)
        valid: Mask = ~np.any(unsure, axis=1)
        if valid.mean() >= MIN_SMOOTH_SHARE:
            break
    else:
        valid[:] = True  # no smooth motion at all: use rough accelerations
    edge = max(edge, speed.half_width)
    valid[:edge] = valid[len(valid) - edge :] = False
    qd = speed.value
    if not uniform:
        qd, qdd = _interpolated(grid, qd, t), _interpolated(grid, qdd, t)
        valid = np.interp(t, grid, valid) > 0.999
    return qd, qdd, valid, speed.noise


def _accelerations(
    q: Array, qd: Array | None, step: float, longest: float, moves: Mask
) -> tuple[Array, Mask, int]:
    """Return accelerations (N, n), where (N, n) they jump, and the rows to drop at either end."""
    from_angles = differentiate(q, step, 2, longest, moves)
    if qd is None:
        return from_angles.value, from_angles.unsure, from_angles.half_width
    from_speeds = differentiate(qd, step, 1, longest, moves)
    # from measured speeds, unless they are noisier than the angles; where the angles jump far more
    # often, their noise is not white (quantisation, vibration), and larger than estimated
    fewer_jumps = from_speeds.unsure.mean(axis=0) < FEWER_JUMPS * from_angles.unsure.mean(axis=0)
    use_speeds = fewer_jumps | (from_speeds.noise <= np.maximum(from_angles.noise, 1e-9))
    return (
        np.where(use_speeds, from_speeds.value, from_angles.value),
        np.where(use_speeds, from_speeds.unsure, from_angles.unsure),
        max(from_speeds.half_width, from_angles.half_width),
    )
