"""Signals between their samples: looked up in the past, or followed by a first-order lag."""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.arrays import Array
from gapbridge.core.kernels.reference import JIT

FINE_STEP = 1e-3  # s: a lag's command is filled in to at least this rate


def interpolate(time: Array, value: Array, at: Array) -> Array:
    """Return a signal (N,) at other times (M,) by a cubic spline; beyond its ends they hold."""
    if len(time) < 4:
        return np.interp(at, time, value)
    return splined(time, value, np.clip(at, time[0], time[-1]))


def splined(time: Array, value: Array, at: Array) -> Array:
    """Return a signal (N,), N >= 4, at other times (M,) by the cubic spline through its samples.

    Not-a-knot at both ends, as scipy's CubicSpline, whose import takes half a second.
    """
    out = np.empty(len(at))
    _spline(*(np.ascontiguousarray(part) for part in (time, value, at)), out)
    return out


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
    """Return the output (N,) of play of half width ``width`` for a command, starting at ``first``.

    It is constant while the command is within the width, and follows at either end of it.
    A negative width, which only steps of a solver ask for, gives the odd continuation.
    """
    result = _pushed(np.ascontiguousarray(command), abs(width), first)
    return np.asarray(result if width >= 0 else 2 * command - result)


@njit(**{**JIT, "error_model": "python"})  # type: ignore[misc,untyped-decorator,unused-ignore]
def _spline(x: Array, y: Array, at: Array, out: Array) -> None:
    """Slopes at the samples by elimination (de Boor 1978, ch. IV), then Hermite's cubics."""
    n = len(x)
    slope, upper = np.empty(n), np.empty(n)  # s_i = slope_i - upper_i s_{i+1}
    first, second, third = x[1] - x[0], x[2] - x[1], x[2] - x[0]
    rise = (y[1] - y[0]) / first
    after = (y[2] - y[1]) / second
    upper[0] = third / second
    slope[0] = ((first + 2.0 * third) * second * rise + first * first * after) / third / second
    for i in range(1, n - 1):
        before, ahead = x[i] - x[i - 1], x[i + 1] - x[i]
        after = (y[i + 1] - y[i]) / ahead
        pivot = 2.0 * (before + ahead) - ahead * upper[i - 1]
        upper[i] = before / pivot
        right = 3.0 * (ahead * rise + before * after)
        slope[i] = (right - ahead * slope[i - 1]) / pivot
        rise = after
    last, second, third = x[n - 1] - x[n - 2], x[n - 2] - x[n - 3], x[n - 1] - x[n - 3]
    before = (y[n - 2] - y[n - 3]) / second
    right = (last * last * before + (2.0 * third + last) * second * rise) / third
    slope[n - 1] = (right - third * slope[n - 2]) / (second - third * upper[n - 2])
    for i in range(n - 2, -1, -1):
        slope[i] -= upper[i] * slope[i + 1]
    i = 0
    for k in range(len(at)):
        if at[k] < x[i] or (i < n - 2 and at[k] >= x[i + 1]):
            i = min(max(np.searchsorted(x, at[k], side="right") - 1, 0), n - 2)
        width = x[i + 1] - x[i]
        u = (at[k] - x[i]) / width
        rise = (y[i + 1] - y[i]) / width
        bend = 3.0 * rise - 2.0 * slope[i] - slope[i + 1]
        twist = slope[i] + slope[i + 1] - 2.0 * rise
        out[k] = y[i] + width * u * (slope[i] + u * (bend + u * twist))


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
