"""Signals between their samples: looked up in the past, or followed by a first-order lag."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from gapbridge.core.arrays import Array
from gapbridge.core.kernels.reference import JIT

if TYPE_CHECKING:
    from gapbridge.core.motion import Motion

FINE_STEP = 1e-3  # s: a lag's command is filled in to at least this rate


def stretches(motion: Motion) -> list[slice]:
    """Return the rows of each stretch without a gap in time."""
    cuts = np.flatnonzero(np.diff(motion.stretch)) + 1
    edges = [0, *(int(c) for c in cuts), len(motion)]
    return [slice(a, b) for a, b in pairwise(edges)]


def interpolate(time: Array, value: Array, at: Array) -> Array:
    """Return a signal (N,) at other times (M,) by a cubic spline; beyond its ends they hold."""
    if len(time) < 4:
        return np.interp(at, time, value)
    from scipy.interpolate import CubicSpline  # half a second that few need to wait for

    return np.asarray(CubicSpline(time, value)(np.clip(at, time[0], time[-1])))


def lagged(time: Array, command: Array, constant: float, first: float) -> Array:
    """Return the response (N,) of a first-order lag to a command (N,): T dy/dt = u - y.

    ``constant`` is T in s, 0 or more; ``first`` the response at the first sample. Exact for a
    command that runs as a ramp from sample to sample; where the log is coarser than 1 ms, a cubic
    spline fills in.
    """
    if constant <= 0.0 or len(time) < 2:
        return command.copy()
    fine = max(int(np.ceil(float(np.median(np.diff(time))) / FINE_STEP - 1e-6)), 1)
    if fine == 1:
        return np.asarray(_follow(time, command, constant, first))
    grid = time[:-1, None] + np.diff(time)[:, None] * (np.arange(fine) / fine)
    dense = np.append(grid.ravel(), time[-1])
    late = _follow(dense, interpolate(time, command, dense), constant, first)
    return np.asarray(late[::fine])


def played(command: Array, width: float, first: float) -> Array:
    """Return what follows a command (N,) with play of half width ``width``, from ``first`` on.

    It stands still while the command is within the width, and is pushed along at either end of it.
    A negative width, which only steps of a solver ask for, is continued oddly.
    """
    result = _pushed(command, abs(width), first)
    return np.asarray(result if width >= 0 else 2 * command - result)


@njit(**JIT)  # type: ignore[misc,untyped-decorator,unused-ignore]
def _pushed(command: Array, width: float, first: float) -> Array:
    moved = np.empty_like(command)
    now = first
    for k in range(len(command)):
        now = min(max(now, command[k] - width), command[k] + width)
        moved[k] = now
    return moved


@njit(**{**JIT, "error_model": "python"})  # type: ignore[misc,untyped-decorator,unused-ignore]
def _follow(time: Array, command: Array, constant: float, first: float) -> Array:
    late = np.empty_like(command)
    late[0] = first
    for k in range(1, len(command)):
        ratio = (time[k] - time[k - 1]) / constant
        gone = -np.expm1(-ratio)  # share of the difference that has decayed
        ramp = gone / ratio
        late[k] = (
            (1.0 - gone) * late[k - 1]
            + (ramp - 1.0 + gone) * command[k - 1]
            + (1.0 - ramp) * command[k]
        )
    return late
