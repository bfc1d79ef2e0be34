"""Log check for torques or wrenches on another clock than the joint angles.

What a motor or a sensor reads is linear in what the links and the load weigh, in friction and in a
constant. If earlier or later angles explain the readings of a recording much better, at most joints
or axes alike, the readings come late or early: friction, payloads and offsets that are fitted to
them would be wrong with small standard deviations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gapbridge.core.arrays import Array, Index, Mask
from gapbridge.core.diagnosis.criteria import MAX_SHARE_WITH_LAG, MAX_SHARE_WITH_OTHER_SIGN
from gapbridge.core.dynamics import contributions_of
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.least_squares import solve
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion, motion_of

MAX_READ = 30_000  # rows: the middle of a longer log
MAX_ROWS = 400  # that are compared, evenly spaced
MIN_ROWS = 60
LONGEST, STEP = 0.5, 0.02  # s, of the lags that are tried
MIN_LAG = 0.05  # s: drives and sensors filter what they read
MAX_SHARE_OF_TIME = 0.125  # of the recording, for the longest lag
MIN_COORDINATES = 2  # joints, or axes of the sensor, that the model explains
FRICTION_LAGS = 11  # of the direction of motion, evenly spaced
MAX_SCATTER = 0.5  # median distance of their own lags from the common one, as a share of it
CHECKS = {
    "actual_current_as_torque": LogCheck.TORQUE_LAG,
    "ft_raw_wrench": LogCheck.WRENCH_LAG,
}


def lag_findings(model: Model, log: Log) -> list[LogFinding]:
    """Return the findings on readings that come late (s, positive) or early (negative)."""
    found = []
    for name, check in CHECKS.items():
        lag, share = reading_lag(model, log, name)
        if share < MAX_SHARE_WITH_LAG:
            found.append(LogFinding(check, (lag,)))
    return found


def reading_lag(model: Model, log: Log, name: str) -> tuple[float, float]:
    """Return how late (s) a column of readings comes, and the share of the residual it leaves.

    The share is the mean of that half of the joints or axes that show it best; 1 if no lag is
    better than none, if they disagree, or if the log is no recording of a motion.
    """
    if not log.has(name) or not log.has("timestamp") or not log.has("actual_q"):
        return 0.0, 1.0
    if name != "ft_raw_wrench" and not model.arm.mass.any():
        return 0.0, 1.0
    if len(log) > MAX_READ:
        first = (len(log) - MAX_READ) // 2
        log = log.select(slice(first, first + MAX_READ))
    try:
        whole = motion_of(log)
    except InputError:  # is refused where it is used
        return 0.0, 1.0
    if not whole.moving:
        return 0.0, 1.0
    readings = log.columns[name][whole.rows]
    lags, rows, earlier = _rows(whole, np.asarray(np.isfinite(readings).all(axis=1)))
    if len(rows) < MIN_ROWS:
        return 0.0, 1.0
    needed, place = np.unique(earlier, return_inverse=True)
    design = _design(model, whole.pick(needed), name)
    place = place.reshape(earlier.shape)
    fixed = _on_any_clock(design, place)
    residual = np.array([_residual(design.own[:, at], fixed, readings[rows]) for at in place])
    return _lag(lags, residual, readings[rows].std(axis=0))


def _rows(motion: Motion, finite: Mask) -> tuple[Array, Index, Index]:
    """Return lags (L,), s, the rows (M,) that are compared, and each lag's rows (L, M) before."""
    t = motion.t
    step = float(np.median(np.diff(t)))
    every = max(round(STEP / step), 1) * step
    count = int(min(LONGEST, MAX_SHARE_OF_TIME * float(t[-1] - t[0])) / every)
    lags: Array = np.arange(-count, count + 1, dtype=float) * every
    rows: Index = np.flatnonzero(finite & motion.valid)
    if not count or not len(rows):
        return lags, rows[:0], np.empty((len(lags), 0), np.int64)
    ends = t[rows[[0, -1]]]
    rows = rows[(t[rows] >= ends[0] + lags[-1]) & (t[rows] <= ends[1] + lags[0])]
    rows = rows[:: max(len(rows) // MAX_ROWS, 1)]
    wanted = t[rows] - lags[:, None]
    after = np.clip(np.searchsorted(t, wanted), 1, len(t) - 1)
    earlier: Index = after - (wanted - t[after - 1] < t[after] - wanted)
    kept = (np.abs(t[earlier] - wanted) <= step).all(axis=0)
    return lags, rows[kept], earlier[:, kept]


class _Design(NamedTuple):
    """Columns of k joints or axes in M rows."""

    own: Array  # (k, M, p): weights, inertia, viscous friction and a constant
    pull: Array  # (k, M, r): of the external force
    direction: Array  # (k, M, 1 or 0) of motion, of Coulomb's friction


def _design(model: Model, motion: Motion, name: str) -> _Design:
    """Return the columns; masses, the load's first moments, friction and constants are free."""
    pieces = contributions_of(model, motion)
    one = np.ones((len(motion), 1))
    if name == "ft_raw_wrench":
        shifted = [pieces.payload_from(axis)[1] for axis in np.eye(3)]
        load = np.hstack([one, pieces.payload_wrench, *shifted])
        own, pull = (np.broadcast_to(x, (6, *x.shape)) for x in (load, pieces.external_wrench))
        return _Design(own, pull, own[:, :, :0])
    columns = [
        np.broadcast_to(one, motion.qd.shape), motion.qd, motion.qdd, pieces.arm_torque,
        pieces.payload_torque,
    ]  # fmt: skip
    own = np.stack(columns, axis=2).swapaxes(0, 1)
    return _Design(own, pieces.external_torque.T[:, :, None], motion.direction.T[:, :, None])


def _on_any_clock(design: _Design, place: Index) -> Array:
    """Return columns (k, M, s) of the pull and of friction, the same with every lag.

    The pull may come from another clock, and friction builds up only some way after a reversal,
    which looks like a lag: neither may decide.
    """
    some = place[np.linspace(0, len(place) - 1, FRICTION_LAGS).astype(int)]
    unmoved = design.pull[:, place[len(place) // 2]]
    return np.concatenate([unmoved, *(design.direction[:, at] for at in some)], axis=2)


def _residual(own: Array, fixed: Array, readings: Array) -> list[float]:
    """Return the rms (k,) that columns (k, M, p) leave of the readings (M, k)."""
    left = []
    for columns, others, values in zip(own, fixed, readings.T, strict=True):
        A = np.hstack([columns, others])
        left.append(float(np.sqrt(np.mean((values - A @ solve(A, values, rank=1e-6)) ** 2))))
    return left


def _lag(lags: Array, residual: Array, spread: Array) -> tuple[float, float]:
    """Return the common lag and the share that it leaves, of residuals (L, k)."""
    none = len(lags) // 2
    explained = residual.min(axis=0) < MAX_SHARE_WITH_OTHER_SIGN * spread
    if explained.sum() < MIN_COORDINATES:
        return 0.0, 1.0
    residual = np.maximum(residual[:, explained], 1e-9 * spread[explained])
    share = residual / residual[none]
    best = int(np.log(share).sum(axis=1).argmin())
    # the half that shows it best: of some joints friction hides it
    half = np.argsort(share[best])[: max(MIN_COORDINATES, -(-share.shape[1] // 2))]
    own = lags[residual[:, half].argmin(axis=0)]
    disagree = np.median(np.abs(own - lags[best])) > MAX_SCATTER * abs(lags[best])
    if abs(lags[best]) < MIN_LAG or best in (0, len(lags) - 1) or disagree:
        return 0.0, 1.0
    return float(lags[best]), float(np.exp(np.log(share[best, half]).mean()))
