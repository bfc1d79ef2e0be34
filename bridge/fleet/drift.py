"""What drifts: slopes over an arm's sessions, judged by the scatter of the whole fleet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from scipy.stats import t as student

from gapbridge.core.arrays import Array

FEWEST = 3  # sessions from which on a slope is reported
WRONG = 0.05  # share of the drifts reported that may be none (Benjamini, Hochberg 1995)
DAY = 86400.0
FAR = 4.0  # robust deviations
FEWEST_VALUES = 8  # values from which on a median's deviation is worth anything


class Figure(Enum):
    """A figure of a session that is no parameter; the value is how reports call it."""

    GAP = "gap"
    UNEXPLAINED = "gap that stays unexplained"
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
    group: str  # series of a group scatter alike
    at: Array  # (m,) days, or numbers of sessions
    per: str  # "day" or "session"
    value: Array  # (m,)
    std: Array  # (m,)
    sessions: tuple[str, ...]


@dataclass(frozen=True)
class Drift:
    """A slope that is reported."""

    arm: str
    quantity: Quantity
    unit: str
    per: str
    slope: float
    std: float
    p_value: float
    at: tuple[float, ...] = ()
    value: tuple[float, ...] = ()
    sessions: tuple[str, ...] = ()

    @property
    def change(self) -> float:
        """Return the change from the first session to the last."""
        return self.slope * (self.at[-1] - self.at[0]) if self.at else math.nan


def places(times: Sequence[float | None]) -> tuple[Array, str]:
    """Return where an arm's sessions stand (m,): days where all have a date, else their numbers."""
    if times and all(t is not None for t in times):
        given = np.array([float(t or 0.0) for t in times])
        if np.ptp(given) > 0:
            return (given - given[0]) / DAY, "day"
    return np.arange(len(times), dtype=float), "session"


def drifts(series: Sequence[Series]) -> list[Drift]:
    """Return the slopes that are more than scatter, surest first.

    Values scatter more from session to session than their own 1 sigma say: by how much is taken
    from all series of a group together. Of what is reported at most one in twenty is none.
    """
    fits = [(s, *_line(s)) for s in series if len(s.at) >= FEWEST and np.ptp(s.at) > 0]
    scatter: dict[str, tuple[float, int]] = {}
    for one, _, _, squares, freedom in fits:
        before = scatter.get(one.group, (0.0, 0))
        scatter[one.group] = (before[0] + squares, before[1] + freedom)
    found = []
    for one, slope, std, _, _ in fits:
        squares, freedom = scatter[one.group]
        wide = std * math.sqrt(max(squares / freedom, 1.0))
        p = float(2 * student.sf(abs(slope) / wide, freedom))
        found.append(Drift(
            one.arm, one.quantity, one.unit, one.per, slope, wide, p, tuple(one.at.tolist()),
            tuple(one.value.tolist()), one.sessions,
        ))  # fmt: skip
    return believed(found)


def believed(drifts: Sequence[Drift]) -> list[Drift]:
    """Return those that hold when as many were looked at, surest first."""
    ordered = sorted(drifts, key=lambda d: d.p_value)
    limit = 0
    for i, drift in enumerate(ordered, start=1):
        if drift.p_value <= WRONG * i / len(ordered):
            limit = i
    return ordered[:limit]


def _line(series: Series) -> tuple[float, float, float, int]:
    """Return slope, its 1 sigma, the sum of squares about the line and its freedom."""
    weight = 1 / np.maximum(series.std, 1e-300) ** 2
    middle = float(weight @ series.at / weight.sum())
    t = series.at - middle
    information = float(weight @ t**2)
    slope = float(weight @ (t * series.value)) / information
    level = float(weight @ series.value / weight.sum())
    left = (series.value - level - slope * t) / series.std
    return slope, 1 / math.sqrt(information), float(left @ left), len(t) - 2


@dataclass(frozen=True)
class Outlier:
    """One arm or session that is unlike the others."""

    arm: str
    session: str  # empty: the arm as a whole
    quantity: Quantity
    value: float
    usual: float
    unit: str
    deviations: float


def far_from_median(values: Sequence[float], *, ratios: bool) -> list[tuple[int, float, float]]:
    """Return (index, usual value, deviations) of values far from the median.

    ``ratios``: values are positive, judged by their ratio to the median, and only those above it
    are far. The deviation is the median one; where more than half agree exactly, nothing is far.
    """
    given = np.array(values, dtype=float)
    if len(given) < FEWEST_VALUES:
        return []
    shown = np.log(np.maximum(given, 1e-300)) if ratios else given
    middle = float(np.median(shown))
    spread = 1.4826 * float(np.median(np.abs(shown - middle)))
    if spread <= 0:
        return []
    usual = math.exp(middle) if ratios else middle
    deviations = (shown - middle) / spread
    return [(int(i), usual, float(deviations[i])) for i in np.flatnonzero(np.abs(deviations) > FAR)]
