"""Shared by the channels of recordings: samples, conditions, quantities, noise of a signal."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Index
from gapbridge.core.derivatives import signal_noise
from gapbridge.core.diagnosis.criteria import MIN_TORQUE_CHANGE, SMOOTHED, STEPPED_SHARE
from gapbridge.core.diagnosis.observation import HELD_TORQUE
from gapbridge.core.diagnosis.thinning import drawn
from gapbridge.core.estimation.held_out import pose_groups
from gapbridge.core.log.columns import scalars
from gapbridge.core.log.log import Log
from gapbridge.core.motion import Motion
from gapbridge.core.sessions import session_of

MAX_POSES = 30_000  # poses at rest: limited by memory
STRETCHES = 24  # conditions of a recording: even stretches of time
MIN_CONDITIONS = 5
MIN_TORQUE = 1e-3  # Nm
CLEAR_CHANGE = 1e-3  # of the largest expected change of the same unit: a reading has to change too
CONSTANT_SPREAD = 1e-9  # spread below which a quantity counts as constant


def subsampled(log: Log, usable: NDArray[np.bool_], motion: Motion) -> Index:
    """Return at most MAX_POSES of the ``usable`` rows (N,) of a log's motion, as indices to it."""
    rows = np.flatnonzero(usable)
    return rows[drawn(session_of(log)[motion.rows[rows]], MAX_POSES)]


def without_dead(
    log: Log, readings: Array, motion: Motion, alike: int, predict: Callable[[Motion], Array]
) -> tuple[Array, tuple[str, ...]]:
    """Return the readings (N, k), NaN in sessions whose sensor is dead, and what is dead.

    A dead sensor never changes although the arm moves, or gives zeros alone; a dead axis never
    changes where ``predict``, (M, k) of a motion, changes clearly beside the others of its unit, of
    which there are ``alike``. An axis is named by its index, the whole sensor by nothing.
    """
    session, finite = session_of(log), np.isfinite(readings).all(axis=1)
    alive, dead = readings.copy(), set()
    for number in np.unique(session):
        rows = np.flatnonzero(finite & (session == number))
        constant = (readings[rows] == readings[rows[:1]]).all(axis=0)
        if len(rows) < 2 or not constant.any():
            continue
        if constant.all():
            q = motion.q[np.isin(motion.rows, rows)]
            axes = [""] if np.any(q != q[:1]) or not readings[rows].any() else []
        else:
            here = motion.pick(motion.valid & np.isin(motion.rows, rows))
            change = np.ptp(predict(here), axis=0) if len(here) else np.zeros(len(constant))
            units = change.reshape(-1, alike)
            clear = (units > CLEAR_CHANGE * units.max(axis=1, keepdims=True)).ravel()
            axes = [f"_{axis}" for axis in np.flatnonzero(constant & clear)]
        if axes:
            alive[rows] = np.nan
            dead |= {*axes}
    return alive, tuple(sorted(dead))


def living(column: str, dead: tuple[str, ...]) -> tuple[str, ...]:
    """Return what a channel without usable rows needs, given what is ``dead`` of its column."""
    return tuple(f"{column}{axis} that changes" for axis in dead) or (column,)


def conditions(motion: Motion) -> Index:
    """Return the condition of each row: its stretch of time if moving, else its pose.

    Where the log holds fewer than five poses, another load counts as another condition.
    """
    if motion.moving:
        t = motion.recorded_time
        number = t / max(float(t[-1]), 1e-9) * STRETCHES
        return np.asarray(np.minimum(number.astype(np.int64), STRETCHES - 1))
    loads = motion.loads
    groups = pose_groups(motion.q)
    if groups.max() + 1 >= MIN_CONDITIONS:
        return groups
    load_columns = [loads.payload_mass, loads.payload_cog, loads.wrench]
    columns = [np.asarray(c).reshape(len(motion), -1) for c in load_columns if c is not None]
    table = np.column_stack([groups, *columns])
    condition = np.unique(np.round(table, 6), axis=0, return_inverse=True)[1].reshape(-1)
    if condition.max() + 1 >= MIN_CONDITIONS:
        return np.asarray(condition)
    return np.arange(len(motion))


def quantities(log: Log, motion: Motion) -> dict[str, Array]:
    """Return what a residual may depend on: columns of the log, and speeds, where they vary."""
    columns: dict[str, Array | None] = {
        "timestamp": motion.t,
        "actual_q" if log.has("actual_q") else "target_q": motion.q,
        "actual_qd": motion.qd,
    }
    for name in ("session", "payload", "payload_cog", "joint_temperatures", "actual_TCP_force"):
        column = log.get(name)
        columns[name] = None if column is None else column[motion.rows]
    return varying(columns)


def varying(columns: Mapping[str, Array | None]) -> dict[str, Array]:
    """Return each scalar (N,) of columns (N,) or (N, k) that varies, by its name in the log."""
    return {
        name: values
        for name, values in scalars(columns).items()
        if np.isfinite(values).all() and np.ptp(values) > CONSTANT_SPREAD
    }


def held_torques(motion: Motion) -> dict[str, Array]:
    """Return the static torques of the joints that vary, as quantities, Nm."""
    if motion.held is None:
        return {}
    largest = max(float(np.abs(motion.held).max(initial=0.0)), MIN_TORQUE)
    return {
        f"{HELD_TORQUE}_{i}": motion.held[:, i]
        for i in np.flatnonzero(np.ptp(motion.held, axis=0) > MIN_TORQUE_CHANGE * largest)
    }


def instrument_noise(signal: Array, motion: Motion) -> Array | None:
    """Return 1 sigma (k,) of a recorded signal (N, k) from differences of neighbouring samples.

    At least the quantisation noise (step over the root of 12). None for poses at rest, because
    neighbours in the log are different poses, and for a signal that was smoothed: the higher the
    differences, the less they show.
    """
    if not motion.moving:
        return None
    signal = signal[np.isfinite(signal).all(axis=1)]
    noise = np.maximum(signal_noise(signal), signal_step(signal) / np.sqrt(12))
    # white noise of 1 sigma has fourth differences of root 70, sixth ones of root 924
    of_sixth = signal_noise(np.diff(signal, 2, axis=0)) * np.sqrt(70 / 924)
    return None if np.any(of_sixth < SMOOTHED * noise) else np.asarray(noise)


def signal_step(signal: Array) -> Array:
    """Return the quantisation step (k,) of each signal (N, k); 0: continuous."""
    steps = np.zeros(signal.shape[1])
    for j, values in enumerate(signal.T):
        distinct = np.unique(values)
        # a continuous signal repeats no value; a stepped one has far fewer values than samples
        if 2 < len(distinct) < STEPPED_SHARE * len(values):
            steps[j] = float(np.diff(distinct).min())
    return steps


def joint_axes(n: int) -> tuple[str, ...]:
    """Return the names of coordinates that are joints."""
    return tuple(f"joint {i + 1}" for i in range(n))


def own_joints(count: int, n: int) -> Array:
    """Return the joint columns (N, n, n) of channels whose coordinates are the joints."""
    return np.broadcast_to(np.eye(n), (count, n, n))
