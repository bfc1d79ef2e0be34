"""Drifts: slopes over an arm's sessions, tested against the scatter of the whole fleet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.stats import t as student

from gapbridge.core.arrays import Array

MIN_SESSIONS = 3  # for a slope
FALSE_DISCOVERY_RATE = 0.05  # Benjamini, Hochberg 1995
DAY = 86400.0
OUTLIER_DEVIATIONS = 4.0  # robust standard deviations from the median
MIN_VALUES = 8  # for a median deviation


class Figure(Enum):
    """A figure of a session that is not a parameter; the value is its name in reports."""

    GAP = "gap"
    UNEXPLAINED = "unexplained gap"
    MISFIT = "misfit of the session"


@dataclass(frozen=True)
class ChannelFigure:
    """A figure of one channel."""

    channel: str
    figure: Figure


Quantity = str | ChannelFigure  # a parameter's public name, or a figure


@dataclass(frozen=True)
class Series:
    """A value of one arm over its sessions."""

    arm: str
    quantity: Quantity
    unit: str
    group: str  # series of a group share one scatter
    times: Array  # (m,) days, or indices of sessions
    per: str  # "day" or "session"
    value: Array  # (m,)
    std: Array  # (m,) 1 sigma of value
    sessions: tuple[str, ...]


@dataclass(frozen=True)
class Drift:
    """A slope of a quantity over the sessions of an arm, in ``unit`` per day or session."""

    arm: str
    quantity: Quantity
    unit: str
    per: str
    slope: float
    std: float
    p_value: float
    times: tuple[float, ...] = ()
    value: tuple[float, ...] = ()
    sessions: tuple[str, ...] = ()

    @property
    def change(self) -> float:
        """Return the change from the first session to the last."""
        return self.slope * (self.times[-1] - self.times[0]) if self.times else math.nan


def session_times(times: Sequence[float | None]) -> tuple[Array, str]:
    """Return times of sessions (m,), and their unit: days if all have a date, else indices."""
    if times and all(t is not None for t in times):
        seconds = np.array([float(t or 0.0) for t in times])
        if np.ptp(seconds) > 0:
            return (seconds - seconds[0]) / DAY, "day"
    return np.arange(len(times), dtype=float), "session"


def significant_drifts(series: Sequence[Series]) -> list[Drift]:
    """Return the significant slopes, smallest p-value first.

    Values scatter more from session to session than their own 1 sigma: the factor is estimated
    from all series of a group. The false discovery rate is FALSE_DISCOVERY_RATE.
    """
    fits = [(s, *_line(s)) for s in series if len(s.times) >= MIN_SESSIONS and np.ptp(s.times) > 0]
    scatter: dict[str, tuple[float, int]] = {}
    for one, _, _, squares, freedom in fits:
        before = scatter.get(one.group, (0.0, 0))
        scatter[one.group] = (before[0] + squares, before[1] + freedom)
    drifts = []
    for one, slope, std, _, _ in fits:
        squares, freedom = scatter[one.group]
        scaled_std = std * math.sqrt(max(squares / freedom, 1.0))
        p = float(2 * student.sf(abs(slope) / scaled_std, freedom))
        drifts.append(Drift(
            one.arm, one.quantity, one.unit, one.per, slope, scaled_std, p,
            tuple(one.times.tolist()), tuple(one.value.tolist()), one.sessions,
        ))  # fmt: skip
    return significant(drifts)


def significant(drifts: Sequence[Drift]) -> list[Drift]:
    """Return the drifts significant after the multiple-testing correction, lowest p first."""
    ordered = sorted(drifts, key=lambda d: d.p_value)
    limit = 0
    for i, drift in enumerate(ordered, start=1):
        if drift.p_value <= FALSE_DISCOVERY_RATE * i / len(ordered):
            limit = i
    return ordered[:limit]


def _line(series: Series) -> tuple[float, float, float, int]:
    """Return slope, its 1 sigma, the weighted sum of squared residuals, degrees of freedom."""
    weight = 1 / np.maximum(series.std, 1e-300) ** 2
    mean_time = float(weight @ series.times / weight.sum())
    t = series.times - mean_time
    information = float(weight @ t**2)
    slope = float(weight @ (t * series.value)) / information
    level = float(weight @ series.value / weight.sum())
    residual = (series.value - level - slope * t) / series.std
    return slope, 1 / math.sqrt(information), float(residual @ residual), len(t) - 2


@dataclass(frozen=True)
class Outlier:
    """A value of an arm or session that is far from those of the others."""

    arm: str
    session: str  # empty: the whole arm
    quantity: Quantity
    value: float
    usual: float  # median of the others
    unit: str
    deviations: float


def median_outliers(
    values: Sequence[float], *, ratios: bool, stds: Sequence[float | None] = ()
) -> list[tuple[int, float, float]]:
    """Return (index, median, deviations) of the values far from the median.

    ``ratios``: values are positive and compared by their logarithm. Deviations are in units of the
    scaled median absolute deviation, with a value's own 1 sigma (``stds``, where known) added in
    squares; if the first is zero, there are no outliers.
    """
    data = np.array(values, dtype=float)
    if len(data) < MIN_VALUES:
        return []
    scaled = np.log(np.maximum(data, 1e-300)) if ratios else data
    middle = float(np.median(scaled))
    spread = 1.4826 * float(np.median(np.abs(scaled - middle)))
    if spread <= 0:
        return []
    median = math.exp(middle) if ratios else middle
    own = np.array([std or 0.0 for std in stds] or 0.0)
    deviations = (scaled - middle) / np.hypot(spread, own)
    return [
        (int(i), median, float(deviations[i]))
        for i in np.flatnonzero(np.abs(deviations) > OUTLIER_DEVIATIONS)
    ]
