"""What the channels of recordings share: which rows are samples, conditions, quantities."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core.estimation.identification import pose_groups
from core.log.log import Log
from core.motion import Motion

Array = NDArray[np.float64]
Index = NDArray[np.int64]
MOST_SAMPLES = 3000  # rows diagnosed of a long log, evenly picked
STRETCHES = 24  # conditions of a recording: even stretches of time
FEWEST_CONDITIONS = 5
VARIES = 1e-9  # spread below which a quantity counts as constant


def picked(usable: NDArray[np.bool_], most: int = MOST_SAMPLES) -> Index:
    """Return at most ``most`` of the usable rows, evenly spread."""
    rows = np.flatnonzero(usable)
    if len(rows) <= most:
        return rows
    return rows[np.round(np.linspace(0, len(rows) - 1, most)).astype(np.int64)]


def conditions(motion: Motion) -> Index:
    """Return the condition of each row: its stretch of time if moving, else its pose.

    Where the log holds fewer than five poses, another load counts as another condition.
    """
    if motion.moving:
        span = max(float(motion.t[-1] - motion.t[0]), 1e-9)
        number = (motion.t - motion.t[0]) / span * STRETCHES
        return np.asarray(np.minimum(number.astype(np.int64), STRETCHES - 1))
    loads = motion.loads
    groups = pose_groups(motion.q)
    if groups.max() + 1 >= FEWEST_CONDITIONS:
        return groups
    given = [loads.payload_mass, loads.payload_cog, loads.wrench]
    columns = [np.asarray(c).reshape(len(motion), -1) for c in given if c is not None]
    table = np.column_stack([groups, *columns])
    found = np.unique(np.round(table, 6), axis=0, return_inverse=True)[1].reshape(-1)
    if found.max() + 1 >= FEWEST_CONDITIONS:
        return np.asarray(found)
    return np.arange(len(motion))


def quantities(log: Log, motion: Motion) -> dict[str, Array]:
    """Return what a leftover may depend on: columns of the log, and speeds, where they vary."""
    found: dict[str, Array] = {}
    columns: dict[str, Array | None] = {
        "timestamp": motion.t,
        "actual_q" if log.has("actual_q") else "target_q": motion.q,
        "actual_qd": motion.qd,
    }
    for name in ("payload", "payload_cog", "joint_temperatures", "actual_TCP_force"):
        column = log.get(name)
        columns[name] = None if column is None else column[motion.rows]
    for name, values in columns.items():
        if values is None:
            continue
        table = values.reshape(len(motion), -1)
        for i in range(table.shape[1]):
            if np.isfinite(table[:, i]).all() and np.ptp(table[:, i]) > VARIES:
                found[name if values.ndim == 1 else f"{name}_{i}"] = table[:, i]
    return found


def joint_axes(n: int) -> tuple[str, ...]:
    """Return the names of coordinates that are joints."""
    return tuple(f"joint {i + 1}" for i in range(n))


def own_joints(count: int, n: int) -> Array:
    """Return the joint columns (N, n, n) of channels whose coordinates are the joints."""
    return np.broadcast_to(np.eye(n), (count, n, n))
