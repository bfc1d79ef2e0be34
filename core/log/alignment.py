"""Alignment of a simulator's log to the rows of a measured one, by time and motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LogError
from gapbridge.core.log.log import Log
from gapbridge.core.log.sources.resampling import Stream
from gapbridge.core.rotation import nearest_turn

POSE = "actual_TCP_pose"
SAME = 1e-3  # s between two stamps of one row
FAST = 0.05  # s: between rows that follow each other so closely values can be interpolated
APART = {"target_q": 0.01, "actual_q": 0.1}  # rad that a joint may be off: arms track their targets


def aligned(simulated: Log, log: Log) -> Log:
    """Return the simulator's rows at the rows of ``log``; its TCP is ``measured_position``.

    Its rotation, where it has one, is ``measured_rotation``; its joint angles are on the turns of
    ``log``. If both have a ``timestamp``, each row gets the simulator's values at its time,
    interpolated between rows that are close in time; clocks with a constant difference over all
    rows count as equal. Otherwise rows correspond by number. Raises LogError where a row has no
    counterpart, or another pose.
    """
    simulated = _with_position(simulated)
    clocks = log.has("timestamp") and simulated.has("timestamp") and log.one_clock
    found = _by_time(simulated, log) if clocks else _by_row(simulated, log)
    for name, most in APART.items():
        if found.has(name) and log.has(name):
            angles = nearest_turn(found.require(name), log.require(name))
            if (angles != found.columns[name]).any():
                found = replace(found, columns={**found.columns, name: angles})
            _check_motion(found, log, name, most)
    return found


def _with_position(simulated: Log) -> Log:
    """Return the log with the TCP's pose that a UR's recording has, where none was measured."""
    pose = simulated.get(POSE)
    if pose is None or simulated.has("measured_position"):
        return simulated
    pose = simulated.require(POSE)
    own = {"measured_position": pose[:, :3], "measured_rotation": pose[:, 3:]}
    return replace(simulated, columns={**simulated.columns, **own})


def _by_row(simulated: Log, log: Log) -> Log:
    if len(simulated) != len(log):
        raise LogError(
            f"{simulated.path}: found {len(simulated)} rows, expected {len(log)}: one per row of "
            f"{log.path}, or a timestamp in both"
        )
    return simulated


def _by_time(simulated: Log, log: Log) -> Log:
    wanted, given = log.require("timestamp"), simulated.require("timestamp")
    if len(wanted) == len(given) and np.ptp(wanted - given) < SAME:
        return simulated  # rows correspond, with any offset of the clocks
    stream = Stream(simulated.path, given, _numbers(simulated)).in_order()
    nearest = _nearest(stream.time, wanted)
    exact = np.abs(stream.time[nearest] - wanted) < SAME
    columns, covered = stream.at(wanted)
    if len(stream.time) < 2 or np.median(np.diff(stream.time)) > FAST:
        covered = exact
    if not (covered | exact).all():
        row = int(np.argmin(covered | exact))
        raise LogError(
            f"{simulated.path}: timestamp: found no row for row {log.line(row)} of {log.path} at "
            f"{wanted[row]:.6g} s (the nearest is at {stream.time[nearest[row]]:.6g} s), expected "
            f"one for each, within {SAME:g} s, or rows no more than {FAST:g} s apart"
        )
    for name, values in columns.items():
        values[exact] = stream.columns[name][nearest[exact]]
        if simulated.columns[name].ndim == 1:
            columns[name] = values[:, 0]
    return replace(simulated, columns=columns, lines=None, numbers=None)


def _numbers(simulated: Log) -> dict[str, Array]:
    """Return the columns as (N, k) arrays."""
    return {name: v.reshape(len(v), -1) for name, v in simulated.columns.items()}


def _nearest(time: Array, wanted: Array) -> NDArray[np.intp]:
    """Return the index of the nearest of the sorted ``time`` (N,) for each of ``wanted`` (M,)."""
    after = np.clip(np.searchsorted(time, wanted), 1 if len(time) > 1 else 0, len(time) - 1)
    before = np.maximum(after - 1, 0)
    return np.where(wanted - time[before] < time[after] - wanted, before, after)


def _check_motion(simulated: Log, log: Log, name: str, most: float) -> None:
    off = np.abs(simulated.require(name) - log.require(name))
    if (off > most).any():
        row, joint = (int(v) for v in np.argwhere(off > most)[0])
        raise LogError(
            f"{simulated.path}: joint {joint + 1} ({name}_{joint}): found "
            f"{simulated.columns[name][row, joint]:.4f} rad where row {log.line(row)} of "
            f"{log.path} has {log.columns[name][row, joint]:.4f}, expected the same motion to "
            f"{most:g} rad"
        )
