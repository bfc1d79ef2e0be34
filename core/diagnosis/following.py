"""Delay and lag as they really act, not only by their slopes.

To first order both are the speed times the time, so that a search by slopes takes the one for the
other, and what is then left looks like a third cause.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from core.diagnosis.candidate import Candidate, named_columns
from core.diagnosis.observation import Observation
from core.dynamics import TRACKING
from core.effects import Term

Array = NDArray[np.float64]
SHORTEST = 1e-6  # s: a chord needs a length


def exact_columns(observation: Observation, candidate: Candidate, base: Sequence[Term]) -> Array:
    """Return a candidate's columns (N, k, d) at the model found so far.

    Of a delay or a lag it is the chord from nothing to the time that the joint comes late: exact
    there for the one as for its twin, so that both compete on what they really predict.
    """
    inside = [t for t in base if t.effect in TRACKING and t.site.joint == candidate.site.joint]
    if candidate.family not in TRACKING or len(inside) > 1:
        return named_columns(observation, candidate, base)
    others = [t for t in base if t not in inside]
    if inside:
        time = inside[0].values[0]
    else:
        slope = named_columns(observation, candidate, base)
        gap = observation.measured - observation.predict(others)
        time = float(np.sum(slope[..., 0] * gap) / max(float(np.sum(slope**2)), 1e-300))
        if time < SHORTEST:
            return slope
    time = max(time, SHORTEST)
    term = candidate.term(np.array([time]))
    moved = observation.predict([*others, term]) - observation.predict(others)
    return np.asarray(moved / time)[..., None]
