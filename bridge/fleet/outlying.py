"""What stands out: values far from those of the same kind, judged by medians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gapbridge.bridge.fleet.drift import Quantity

FAR = 4.0  # robust deviations
FEWEST = 8  # values from which on a median's deviation is worth anything


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
    if len(given) < FEWEST:
        return []
    shown = np.log(np.maximum(given, 1e-300)) if ratios else given
    middle = float(np.median(shown))
    spread = 1.4826 * float(np.median(np.abs(shown - middle)))
    if spread <= 0:
        return []
    usual = math.exp(middle) if ratios else middle
    deviations = (shown - middle) / spread
    return [(int(i), usual, float(deviations[i])) for i in np.flatnonzero(np.abs(deviations) > FAR)]
