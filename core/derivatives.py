"""Derivatives of sampled signals: Savitzky-Golay filters whose window follows the noise.

A short window lets noise through, a long one flattens the motion. The window grows as long as the
derivative changes by no more than its own noise explains (Lepski's rule), joint by joint. Source
of the filter: Savitzky, Golay, Analytical Chemistry 36 (1964) 1627.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_coeffs, savgol_filter

Array = NDArray[np.float64]
HALF_WIDTHS = (3, 4, 6, 9, 13, 19, 28, 42, 63)  # samples either side
LONGEST = 0.3  # s, no window reaches further either side
BIAS_SHARE = 0.5  # of the noise: how much flattening a longer window may bring


@dataclass(frozen=True)
class Derivative:
    """A derivative of N samples of n signals, and what is known of its error."""

    value: Array  # (N, n) unit of the signal per s^order
    noise: Array  # (n,) 1 sigma that the signal's noise makes in it
    half_width: int  # samples at either end that the longest window did not cover


def signal_noise(signal: Array) -> Array:
    """Return 1 sigma of the white noise on each of n smooth signals (N, n), by 4th differences.

    The tails are cut at the 95th percentile, so that a few corners of the motion do not count.
    """
    if len(signal) < 8:
        return np.zeros(signal.shape[1])
    size = np.abs(np.diff(signal, 4, axis=0)) / np.sqrt(70.0)
    # rms of the lower 95 % of a normal's absolute values is 0.871 sigma
    limit = np.quantile(size, 0.95, axis=0)
    kept = np.where(size <= limit, size, np.nan)
    return np.asarray(np.sqrt(np.nanmean(kept**2, axis=0)) / 0.871)


def differentiate(signal: Array, step: float, order: int) -> Derivative:
    """Return the ``order``-th derivative (1 or 2) of ``signal`` (N, n), sampled every ``step`` s.

    N must be at least 7.
    """
    count, n = signal.shape
    widest = max(min(LONGEST / step, (count - 1) // 4), 3)
    halves = [h for h in HALF_WIDTHS if h <= widest]
    sigma = signal_noise(signal)
    filters = [_coefficients(h, order, step) for h in halves]
    value, noise, chosen = np.empty((count, n)), np.zeros(n), np.zeros(n, dtype=int)
    candidates = [_filtered(signal, halves[0], order, step)]
    for j in range(n):
        k = 0
        while k + 1 < len(halves):
            if len(candidates) < k + 2:
                candidates.append(_filtered(signal, halves[k + 1], order, step))
            if not _may_grow(
                candidates[k][:, j], candidates[k + 1][:, j], sigma[j], filters[k], filters[k + 1]
            ):
                break
            k += 1
        value[:, j], chosen[j] = candidates[k][:, j], halves[k]
        noise[j] = sigma[j] * np.linalg.norm(filters[k])
    return Derivative(value, noise, int(chosen.max(initial=3)))


def _polynomial(order: int) -> int:
    return 2 + order


def _coefficients(half: int, order: int, step: float) -> Array:
    return np.asarray(
        savgol_coeffs(2 * half + 1, _polynomial(order), deriv=order, delta=step), dtype=float
    )


def _filtered(signal: Array, half: int, order: int, step: float) -> Array:
    return np.asarray(
        savgol_filter(signal, 2 * half + 1, _polynomial(order), deriv=order, delta=step, axis=0)
    )


def _may_grow(now: Array, wider: Array, sigma: float, h: Array, h_wider: Array) -> bool:
    """Return whether a wider window changes the derivative by no more than noise explains."""
    change = h_wider.copy()
    margin = (len(h_wider) - len(h)) // 2
    change[margin : margin + len(h)] -= h
    explained = sigma**2 * (change @ change)
    allowed = BIAS_SHARE**2 * sigma**2 * (h_wider @ h_wider)
    return bool(np.mean((wider - now) ** 2) <= 1.1 * explained + allowed)
