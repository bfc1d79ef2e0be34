"""Delay or lag: decided on the exact predictions, joint by joint.

To first order both are the speed times the time, so that a linear search takes one for the other,
and what then is left looks like a third. Each joint has a coordinate of its own, so that the few
sets in question are fitted exactly and compared.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from core.diagnosis.candidate import Candidate, named_columns
from core.diagnosis.observation import Observation
from core.diagnosis.refit import refit
from core.diagnosis.space import Found, Space, fit
from core.diagnosis.work import Work, flat
from core.dynamics import TRACKING
from core.effects import Term

Array = NDArray[np.float64]
SHORTEST = 1e-6  # s: a chord needs a length


def exact_columns(observation: Observation, candidate: Candidate, base: Sequence[Term]) -> Array:
    """Return a candidate's columns (N, k, d); delay and lag as chords where one of them is found.

    A chord from nothing to the time found is exact there for the one as for its twin, so that both
    compete on what they really predict.
    """
    inside = [t for t in base if t.effect in TRACKING and t.site.joint == candidate.site.joint]
    if candidate.family not in TRACKING or len(inside) != 1:
        return named_columns(observation, candidate, base)
    others, time = [t for t in base if t is not inside[0]], max(inside[0].values[0], SHORTEST)
    term = candidate.term(np.array([time]))
    moved = observation.predict([*others, term]) - observation.predict(others)
    return np.asarray(moved / time)[..., None]


def followed(work: Work, space: Space, found: Found) -> Found:
    """Return the set with each joint's delay and lag as the exact predictions want them."""
    if work.observation.channel != "tracking":
        return found
    chosen = found.chosen
    for joint in range(1, work.observation.measured.shape[1] + 1):
        own = [c for c in chosen if _joint(space, c) == joint]
        if any(space.candidates[c].named for c in own):
            rest = tuple(c for c in chosen if c not in own)
            chosen = rest + _best(work, space, rest, own, joint)
    return found if set(chosen) == set(found.chosen) else fit(space, chosen)


def _joint(space: Space, c: int) -> int | None:
    candidate = space.candidates[c]
    if candidate.named:
        return candidate.site.joint
    stem, _, number = candidate.target.partition("_")
    return int(number) if stem == "joint" else None


def _best(
    work: Work, space: Space, rest: tuple[int, ...], own: list[int], joint: int
) -> tuple[int, ...]:
    """Return the best of a joint's sets: what was found, a delay, a lag, or both."""
    timing = [
        c for c, k in enumerate(space.candidates)
        if k.family in TRACKING and k.site.joint == joint
    ]  # fmt: skip
    sets = {tuple(own), *((c,) for c in timing), tuple(timing)}
    sets |= {(*s, *(c for c in own if not space.candidates[c].named)) for s in sets}
    others = fit(space, rest).rss - _own_square(space.y, work, joint)
    scores = {}
    for chosen in sets:
        rss = max(others, 0.0) + _left(work, space, chosen, joint)
        price = float(space.price[list(chosen)].sum())
        scores[chosen] = float(space.misfit(np.array(rss))) + price
    return min(scores, key=lambda s: scores[s])


def _left(work: Work, space: Space, chosen: tuple[int, ...], joint: int) -> float:
    """Return the sum of squares of a joint's own coordinate after the exact fit of its set."""
    _, _, _, residual = refit(work, space, fit(space, chosen))
    left = flat(residual[..., None], work)[:, 0]
    smooth = space.columns([c for c in chosen if not space.candidates[c].named])
    if smooth.shape[1]:
        left = left - smooth @ np.linalg.lstsq(smooth, left, rcond=1e-9)[0]
    return _own_square(left, work, joint)


def _own_square(values: Array, work: Work, joint: int) -> float:
    own = values.reshape(-1, work.observation.measured.shape[1])[:, joint - 1]
    return float(own @ own)
