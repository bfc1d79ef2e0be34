"""Derivatives of sampled signals: Savitzky-Golay filters whose window follows the noise.

A short window lets noise through, a long one flattens the motion. The window grows as long as the
derivative changes by no more than its own noise explains (Lepski's rule), joint by joint. Where
the motion jumps (the corners of a trapezoidal speed), no window is right: there short and long
windows disagree, and the rows are marked. Source of the filter: Savitzky, Golay, Analytical
Chemistry 36 (1964) 1627.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from math import factorial

import numpy as np

from gapbridge.core.arrays import Array, Mask

HALF_WIDTHS = (3, 4, 6, 9, 13, 19, 28, 42, 63)  # samples either side
LONGEST = 0.3  # s, no window reaches further either side
BIAS_SHARE = 0.5  # of the noise: how much flattening a longer window may bring
SMOOTH_SHARE = 0.7  # of the rows decide on the window; the rest may hold jumps
TRIMMED = 0.3096  # mean square of the smallest 70 % of normal deviates, sigma 1
FALLING, AHEAD = 0.7, 3  # times a change, within so many windows: below, it is noise that falls
CLEAR = 4.5  # sigma of the noise beyond which windows disagree
COARSE = 0.01  # of the derivative's rms: a smaller disagreement matters to nobody
JUDGED = 20_000  # samples beyond which evenly spread pieces of PIECE choose the windows
PIECE = 2048


@dataclass(frozen=True)
class Derivative:
    """A derivative of N samples of n signals, and what is known of its error."""

    value: Array  # (N, n) unit of the signal per s^order
    noise: Array  # (n,) 1 sigma that the signal's noise makes in it
    half_width: int  # samples at either end that the longest window did not cover
    unsure: Mask  # (N, n) the signal jumps here


def signal_noise(signal: Array) -> Array:
    """Return 1 sigma of the white noise on each of n smooth signals (N, n), by 4th differences.

    The tails are cut at the 95th percentile, so that a few corners of the motion do not count. Of a
    long signal evenly spread pieces are looked at.
    """
    if len(signal) < 8:
        return np.zeros(signal.shape[1])
    parts = [np.diff(part, 4, axis=0) for part in _pieces(signal)]
    size = np.abs(parts[0] if len(parts) == 1 else np.concatenate(parts)) / np.sqrt(70.0)
    # rms of the lower 95 % of a normal's absolute values is 0.871 sigma
    limit = np.quantile(size, 0.95, axis=0)
    kept = np.where(size <= limit, size, np.nan)
    return np.asarray(np.sqrt(np.nanmean(kept**2, axis=0)) / 0.871)


def differentiate(signal: Array, step: float, order: int, longest: float = LONGEST) -> Derivative:
    """Return the ``order``-th derivative (1 or 2) of ``signal`` (N, n), sampled every ``step`` s.

    No window reaches further than ``longest`` (s) either side. N must be at least 7. The windows of
    a long signal are chosen by pieces of it.
    """
    count, n = signal.shape
    widest = max(min(longest / step, (count - 1) // 4), 3)
    halves = [h for h in HALF_WIDTHS if h <= widest]
    sigma = signal_noise(signal)
    filters = [_polynomials(h, order)[h, ::-1] / step**order for h in halves]
    pieces = _pieces(signal)
    tried = [[_filtered(part, h, order, step) for part in pieces] for h in halves]
    value, noise = np.empty((count, n)), np.zeros(n)
    chosen, unsure = np.zeros(n, dtype=int), np.zeros((count, n), dtype=bool)
    for j in range(n):
        changes = _changes([np.concatenate([part[:, j] for part in parts]) for parts in tried])
        k = _widest(changes, float(sigma[j]), filters)
        other = k - 1 if k else min(1, len(halves) - 1)

        def along(window: int, j: int = j) -> Array:
            if len(pieces) == 1:
                return tried[window][0][:, j]
            return _filtered(signal[:, j : j + 1], halves[window], order, step)[:, 0]

        value[:, j], chosen[j] = along(k), halves[k]
        # a jittering clock, held samples and vibration are no white noise: more passes a window
        passed = changes[k - 1] / _difference(filters[k - 1], filters[k]) if k else 0.0
        spread = max(float(sigma[j]), float(np.sqrt(passed)))
        noise[j] = spread * np.linalg.norm(filters[k])
        change = np.abs(along(other) - value[:, j])
        typical = float(np.sqrt(np.mean(value[:, j] ** 2)))
        unsure[:, j] = _jumps(change, typical, spread, filters[other], filters[k])
    return Derivative(value, noise, int(chosen.max(initial=3)), unsure)


def _pieces(signal: Array) -> list[Array]:
    """Return the pieces of a signal (N, n) that choose its windows; a short one as a whole."""
    if len(signal) <= JUDGED:
        return [signal]
    begins = np.linspace(0, len(signal) - PIECE, JUDGED // PIECE).astype(int)
    return [signal[begin : begin + PIECE] for begin in begins]


@cache
def _polynomials(half: int, order: int) -> Array:
    """Return the derivative (2 half + 1, 2 half + 1) at each sample of a window, a step of one.

    Row i has what each sample weighs in the ``order``-th derivative, at sample i, of the polynomial
    of degree ``order`` + 2 that fits the window best.
    """
    place, degree = np.arange(-half, half + 1) / half, np.arange(order + 3)
    fit = np.linalg.pinv(place[:, None] ** degree)  # (degrees, window)
    left = np.where(degree >= order, degree - order, 0)
    falling = [factorial(d) / factorial(d - order) if d >= order else 0.0 for d in degree]
    found: Array = (np.array(falling) * place[:, None] ** left) @ fit / half**order
    return found


def _filtered(signal: Array, half: int, order: int, step: float) -> Array:
    """Return the derivative (N, n) of a signal; at its ends that of the last whole window."""
    weights, found = _polynomials(half, order) / step**order, np.empty(signal.shape)
    for j in range(signal.shape[1]):
        found[half : len(signal) - half, j] = np.correlate(
            np.ascontiguousarray(signal[:, j]), weights[half], "valid"
        )
    found[:half] = weights[:half] @ signal[: 2 * half + 1]
    found[len(signal) - half :] = weights[half + 1 :] @ signal[-2 * half - 1 :]
    return found


def _changes(tried: list[Array]) -> list[float]:
    """Return the mean square change of a derivative from each window to the next wider one.

    The rows that change most are left out: the motion may jump there.
    """
    changes = []
    for one, other in pairwise(tried):
        squares = np.sort((other - one) ** 2)[: int(SMOOTH_SHARE * len(one))]
        changes.append(float(squares.mean()) / TRIMMED)
    return changes


def _widest(changes: list[float], sigma: float, filters: list[Array]) -> int:
    """Return the number of the widest window before the motion itself is flattened.

    A change from window to window is noise where white noise explains it, or where it still falls
    with the width: that of a motion being flattened grows (as the width squared).
    """
    for k, change in enumerate(changes):
        explained = 1.1 * _difference(filters[k], filters[k + 1])
        allowed = BIAS_SHARE**2 * float(filters[k + 1] @ filters[k + 1])
        ahead = changes[k + 1 : k + 1 + AHEAD]
        falls = bool(ahead) and min(ahead) < FALLING * change
        if change > sigma**2 * (explained + allowed) and not falls:
            return k
    return len(changes)


def _jumps(change: Array, typical: float, sigma: float, h: Array, other: Array) -> Mask:
    """Return where (N,) two windows disagree, and the rows beside that the wider one mixes in."""
    limit = max(CLEAR * sigma * np.sqrt(_difference(h, other)), COARSE * typical)
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
