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
from core.diagnosis.space import Found, Space, fit
from core.dynamics import TRACKING
from core.effects import Term

Array = NDArray[np.float64]
SHORTEST = 1e-6  # s: a chord needs a length


def exact_columns(observation: Observation, candidate: Candidate, base: Sequence[Term]) -> Array:
    """Return a candidate's columns (N, k, d) at the model found so far.

    Of a delay or a lag it is the chord from nothing to the whole time that the joint comes late:
    exact there for the one as for its twin, so that both compete on what they really predict.
    """
    if candidate.family not in TRACKING:
        return named_columns(observation, candidate, base)
    inside = [t.values[0] for t in base if t.site.joint == candidate.site.joint]
    nothing = observation.predict(())
    if inside:
        time = float(np.sum(inside))
    else:
        slope = named_columns(observation, candidate, ())[..., 0]
        gap = observation.measured - nothing
        time = float(np.sum(slope * gap) / max(float(np.sum(slope**2)), 1e-300))
    if time < SHORTEST:
        return named_columns(observation, candidate, ())
    moved = observation.predict([candidate.term(np.array([time]))]) - nothing
    return np.asarray(moved / time)[..., None]


def one_delay(space: Space, found: Found) -> Found:
    """Return the set with all joints that answer late told as one effect of the controller.

    Latency or lag, whichever fits all of these joints better: each joint by itself decides little.
    """
    site = {(k.family, k.site.joint): c for c, k in enumerate(space.candidates) if k.named}
    late = [c for c in found.chosen if space.candidates[c].family in TRACKING]
    if len(late) < 2:
        return found
    rest = [c for c in found.chosen if c not in late]
    joints = sorted({space.candidates[c].site.joint or 0 for c in late})
    sets = [
        fit(space, (*rest, *(site[effect, j] for j in joints)))
        for effect in TRACKING
        if all((effect, j) in site for j in joints)
    ]
    return min(sets, key=lambda f: f.score, default=found)
