"""Derivatives of sampled signals by Savitzky-Golay filters with adaptive windows.

A short window passes noise, a long one biases the derivative. Per joint, the window grows while the
derivative changes by no more than its noise explains (Lepski's rule). At jumps of the motion (the
corners of a trapezoidal speed) short and long windows disagree; these rows are marked. Rows at rest
choose no window: encoders at rest have less noise than in motion. Source of the filter: Savitzky,
Golay, Analytical Chemistry 36 (1964) 1627.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from math import factorial
from typing import TypeVar

import numpy as np

from gapbridge.core.arrays import Array, Mask

Sampled = TypeVar("Sampled", Array, Mask)
HALF_WIDTHS = (3, 4, 6, 9, 13, 19, 28, 42, 63)  # samples either side
MAX_REACH = 0.3  # s, no window reaches further either side
BIAS_SHARE = 0.5  # allowed bias of a longer window, over the noise
SMOOTH_SHARE = 0.7  # share of the rows, those without jumps, by which the window is chosen
TRIMMED = 0.3096  # mean square of the smallest 70 % of normal deviates, sigma 1
FALLING, LOOK_AHEAD = (
    0.7,
    3,
)  # times a change, within so many windows: below, it is noise that falls
JUMP_SIGMAS = 4.5  # sigma of the noise beyond which windows disagree
MIN_JUMP = 0.01  # of the derivative's rms: a smaller disagreement matters to nobody
MAX_SAMPLES = 20_000  # samples beyond which evenly spread pieces of PIECE choose the windows
PIECE = 2048
REST_SPEED = 0.02  # of a joint's largest speed, below which it rests
SPEED_REACH = 0.1  # s either side, over which speeds are taken
MIN_MOVING = 100  # samples in motion, with fewer all are used


@dataclass(frozen=True)
class Derivative:
    """A derivative of N samples of n signals, and its noise."""

    value: Array  # (N, n) unit of the signal per s^order
    noise: Array  # (n,) 1 sigma due to the signal's noise
    half_width: int  # samples at either end that the longest window did not cover
    unsure: Mask  # (N, n) the signal jumps here


def signal_noise(signal: Array, moves: Mask | None = None) -> Array:
    """Return 1 sigma of the white noise on each of n smooth signals (N, n), by 4th differences.

    Values above the 95th percentile are excluded, for corners of the motion. Of a long signal
    evenly spread pieces are used. ``moves`` (N, n): the samples that count.
    """
    if len(signal) < 8:
        return np.zeros(signal.shape[1])
    size = np.abs(np.concatenate([np.diff(part, 4, axis=0) for part in _pieces(signal)]))
    size /= np.sqrt(70.0)
    if moves is not None:
        size[~np.concatenate([part[2:-2] for part in _pieces(moves)])] = np.nan
    # rms of the lower 95 % of a normal's absolute values is 0.871 sigma
    limit = np.nanquantile(size, 0.95, axis=0)
    kept = np.where(size <= limit, size, np.nan)
    return np.asarray(np.sqrt(np.nanmean(kept**2, axis=0)) / 0.871)


def differentiate(
    signal: Array, step: float, order: int, longest: float = MAX_REACH, moves: Mask | None = None
) -> Derivative:
    """Return the ``order``-th derivative (1 or 2) of ``signal`` (N, n), sampled every ``step`` s.

    No window reaches further than ``longest`` (s) either side. N must be at least 7. The windows of
    a long signal are chosen by pieces of it. ``moves`` (N, n): the samples that choose them.
    """
    moves = np.ones(signal.shape, dtype=bool) if moves is None else moves
    count, n = signal.shape
    widest = max(min(longest / step, (count - 1) // 4), 3)
    halves = [h for h in HALF_WIDTHS if h <= widest]
    sigma = signal_noise(signal, moves)
    filters = [_polynomials(h, order)[h, ::-1] / step**order for h in halves]
    pieces, counts = _pieces(signal), np.concatenate(_pieces(moves))
    results = [[_filtered(part, h, order, step) for part in pieces] for h in halves]
    value, noise = np.empty((count, n)), np.zeros(n)
    chosen, unsure = np.zeros(n, dtype=int), np.zeros((count, n), dtype=bool)
    for j in range(n):
        changes = _changes_between(
            [np.concatenate([part[:, j] for part in parts])[counts[:, j]] for parts in results]
        )
        k = _widest_window(changes, float(sigma[j]), filters)
        other = k - 1 if k else min(1, len(halves) - 1)

        def of_window(window: int, j: int = j) -> Array:
            if len(pieces) == 1:
                return results[window][0][:, j]
            return _filtered(signal[:, j : j + 1], halves[window], order, step)[:, 0]

        value[:, j], chosen[j] = of_window(k), halves[k]
        # clock jitter, repeated samples and vibration are not white: a window passes more of them
        variance = changes[k - 1] / _difference(filters[k - 1], filters[k]) if k else 0.0
        spread = max(float(sigma[j]), float(np.sqrt(variance)))
        noise[j] = spread * np.linalg.norm(filters[k])
        change = np.abs(of_window(other) - value[:, j])
        typical = float(np.sqrt(np.mean(value[moves[:, j], j] ** 2)))
        unsure[:, j] = _jumps(change, typical, spread, filters[other], filters[k])
    return Derivative(value, noise, int(chosen.max(initial=3)), unsure)


def moving_samples(q: Array, step: float) -> Mask:
    """Return where (N, n) each joint moves; everywhere for one that hardly does.

    ``q`` (N, n) rad, sampled every ``step`` s; N must be at least 3.
    """
    reach = max(min(round(SPEED_REACH / step), (len(q) - 1) // 2), 1)
    speed = np.empty(q.shape)
    speed[reach:-reach] = np.abs(q[2 * reach :] - q[: -2 * reach]) / (2 * reach * step)
    speed[:reach], speed[-reach:] = speed[reach], speed[-reach - 1]
    moves: Mask = speed > REST_SPEED * speed.max(axis=0)
    moves[:, moves.sum(axis=0) < MIN_MOVING] = True
    return moves


def _pieces(signal: Sampled) -> list[Sampled]:
    """Return the pieces of a signal (N, n) used to choose the windows; a short one as a whole."""
    if len(signal) <= MAX_SAMPLES:
        return [signal]
    begins = np.linspace(0, len(signal) - PIECE, MAX_SAMPLES // PIECE).astype(int)
    return [signal[begin : begin + PIECE] for begin in begins]


@cache
def _polynomials(half: int, order: int) -> Array:
    """Return the derivative (2 half + 1, 2 half + 1) at each sample of a window, a step of one.

    Row i holds the weights of the samples in the ``order``-th derivative, at sample i, of the
    least-squares polynomial of degree ``order`` + 2.
    """
    position, degree = np.arange(-half, half + 1) / half, np.arange(order + 3)
    fit = np.linalg.pinv(position[:, None] ** degree)  # (degrees, window)
    exponent = np.where(degree >= order, degree - order, 0)
    factors = [factorial(d) / factorial(d - order) if d >= order else 0.0 for d in degree]
    filters: Array = (np.array(factors) * position[:, None] ** exponent) @ fit / half**order
    return filters


def _filtered(signal: Array, half: int, order: int, step: float) -> Array:
    """Return the derivative (N, n) of a signal; at its ends that of the last whole window."""
    weights, filters = _polynomials(half, order) / step**order, np.empty(signal.shape)
    for j in range(signal.shape[1]):
        filters[half : len(signal) - half, j] = np.correlate(
            np.ascontiguousarray(signal[:, j]), weights[half], "valid"
        )
    filters[:half] = weights[:half] @ signal[: 2 * half + 1]
    filters[len(signal) - half :] = weights[half + 1 :] @ signal[-2 * half - 1 :]
    return filters


def _changes_between(results: list[Array]) -> list[float]:
    """Return the mean square change of a derivative from each window to the next wider one.

    The rows that change most are left out: the motion may jump there.
    """
    changes = []
    for one, other in pairwise(results):
        squares = np.sort((other - one) ** 2)[: int(SMOOTH_SHARE * len(one))]
        changes.append(float(squares.mean()) / TRIMMED)
    return changes


def _widest_window(changes: list[float], sigma: float, filters: list[Array]) -> int:
    """Return the number of the widest window without significant bias.

    A change from window to window is noise if white noise explains it, or if it decreases with the
    width: a bias grows (as the width squared).
    """
    for k, change in enumerate(changes):
        explained = 1.1 * _difference(filters[k], filters[k + 1])
        allowed = BIAS_SHARE**2 * float(filters[k + 1] @ filters[k + 1])
        ahead = changes[k + 1 : k + 1 + LOOK_AHEAD]
        falls = bool(ahead) and min(ahead) < FALLING * change
        if change > sigma**2 * (explained + allowed) and not falls:
            return k
    return len(changes)


def _jumps(change: Array, typical: float, sigma: float, h: Array, other: Array) -> Mask:
    """Return where (N,) two windows disagree, and the rows within the wider window."""
    limit = max(JUMP_SIGMAS * sigma * np.sqrt(_difference(h, other)), MIN_JUMP * typical)
    clear = (change > limit).astype(float)
    if not clear.any():
        return np.zeros(len(clear), dtype=bool)
    half = max(len(h), len(other)) // 2
    return np.asarray(np.convolve(clear, np.ones(2 * half + 1), mode="same") > 0.5)


def _difference(h: Array, wider: Array) -> float:
    """Return the squared norm of the difference of two filters, the shorter one in the middle."""
    if len(h) > len(wider):
        h, wider = wider, h
    change = wider.copy()
    margin = (len(wider) - len(h)) // 2
    change[margin : margin + len(h)] -= h
    return float(change @ change)
