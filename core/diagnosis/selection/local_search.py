"""Local search: terms of a set dropped, swapped, merged, or unnamed ones added."""

from __future__ import annotations

import numpy as np

from gapbridge.core.diagnosis.criteria import FAMILY_PENALTY
from gapbridge.core.diagnosis.selection.forward_selection import (
    additions,
    forward_step,
    joining,
    projected,
)
from gapbridge.core.diagnosis.selection.sample_space import CandidateFit, SampleSpace, fit
from gapbridge.core.estimation.least_squares import inverse, squared_sigmas

MAX_MERGED = 9  # terms up to which pairs are replaced by one, and each by several
MAX_EXCHANGED = 4  # terms exchanged for others at most
MAX_ADDED = 30  # terms added to a set at most


def improve(space: SampleSpace, current: CandidateFit, named_only: bool = False) -> CandidateFit:
    """Return the set after dropping and swapping terms while the score improves."""
    for _ in range(4):
        better = current
        for c in current.chosen:
            others = tuple(o for o in current.chosen if o != c)
            trial = fit(space, others)
            if trial.score < better.score:
                better = trial
            for _, other in additions(space, projected(space, others), 3, named_only):
                if other != c:
                    trial = fit(space, (*others, other))
                    if trial.score < better.score - 1e-6:
                        better = trial
        if better is current and 2 < len(current.chosen) <= MAX_MERGED:
            better = _merged(space, current, named_only)
        if better is current:
            return current
        current = better
    return current


def _merged(space: SampleSpace, current: CandidateFit, named_only: bool) -> CandidateFit:
    """Return the set with two terms replaced by one, if that improves the score."""
    better = current
    for i, one in enumerate(current.chosen):
        for other in current.chosen[i + 1 :]:
            others = tuple(c for c in current.chosen if c not in (one, other))
            for _, new in additions(space, projected(space, others), 2, named_only):
                trial = fit(space, (*others, new))
                if trial.score < better.score - 1e-6:
                    better = trial
    return better


def pruned(space: SampleSpace, current: CandidateFit) -> CandidateFit:
    """Return the set after dropping terms one by one while the score improves."""
    while current.chosen:
        better = None
        for score, c in _drops(space, current):
            if score >= current.score:
                break
            better = fit(space, tuple(o for o in current.chosen if o != c))
            if np.isfinite(better.score):
                break
        if better is None or better.score >= current.score:
            break
        current = better
    return current


def _drops(space: SampleSpace, current: CandidateFit) -> list[tuple[float, int]]:
    """Return the score of the set without each of its terms, best first, from one inverse."""
    X = space.columns(current.chosen)
    spread = inverse(X.T @ X)
    x = spread @ (X.T @ space.y)
    rss = float(np.sum((space.y - X @ x) ** 2))
    paid = float(space.penalty[list(current.chosen)].sum())
    begin, scores = 0, []
    for c in current.chosen:
        values = slice(begin, begin + len(space.candidates[c].parameters))
        begin = values.stop
        more = squared_sigmas(x[values], spread[values, values])
        scores.append((float(space.misfit(np.array(rss + more))) + paid - space.penalty[c], c))
    return sorted(scores)


def joined_sets(space: SampleSpace, current: CandidateFit) -> list[CandidateFit]:
    """Return sets with one more term, an unnamed one above all, without redundant terms.

    Named causes that together imitate an unknown one are dropped once it has its own term. Forward
    selections starting from an unnamed term are returned too.
    """
    unnamed = {c for c, k in enumerate(space.candidates) if k.without_quantity}
    joiners = unnamed | {c for _, c in joining(space, current.chosen, 4)}
    new = sorted(joiners - set(current.chosen))
    sets = [pruned(space, fit(space, (*current.chosen, c))) for c in new]
    if current.chosen:
        sets += [forward_selected(space, fit(space, (c,))) for c in sorted(unnamed)]
    return sets


def exchanged(space: SampleSpace, current: CandidateFit) -> CandidateFit:
    """Return a small set after exchanging single terms for others while the score improves.

    What a term leaves when it is taken out may need several others: an inertia and a torque
    constant may imitate a payload and another torque constant.
    """
    for _ in range(MAX_EXCHANGED):
        better = current
        if len(current.chosen) > MAX_MERGED:
            break
        for c in current.chosen:
            others = fit(space, tuple(o for o in current.chosen if o != c))
            trial = pruned(space, forward_selected(space, others, True, without=c))
            better = min([better, trial], key=lambda f: f.score)
        if better.score >= current.score - 1e-6:
            break
        current = better
    return current


def forward_selected(
    space: SampleSpace, current: CandidateFit, named_only: bool = False, without: int = -1
) -> CandidateFit:
    """Return the set after adding the best terms one by one while the score improves.

    ``without``: a candidate that is not added.
    """
    state = projected(space, current.chosen)
    for _ in range(MAX_ADDED):
        nearest = [a for a in additions(space, state, 2, named_only) if a[1] != without]
        if not nearest or nearest[0][0] >= current.score:
            break
        better = fit(space, (*current.chosen, nearest[0][1]))
        if better.score >= current.score:
            break
        state, current = forward_step(space, state, nearest[0][1], better.score), better
    return current


def rivals(
    space: SampleSpace, best: CandidateFit, c: int, within: float
) -> list[tuple[float, int]]:
    """Return the candidates that could replace ``c`` in a set: (score above the best, index)."""
    others = tuple(o for o in best.chosen if o != c)
    near = []
    for score, other in additions(space, projected(space, others), 40):
        if score > best.score + within:
            break
        if other == c:
            continue
        trial = fit(space, (*others, other))
        if trial.score <= best.score + within:
            near.append((trial.score - best.score, other))
    return sorted(near)


def with_fewest_families(space: SampleSpace, best: CandidateFit) -> CandidateFit:
    """Return the set with the fewest kinds of effects that fit about equally well.

    A term is replaced by an effect of a kind that the set already has, if that fits as well.
    """
    for c in best.chosen:
        family = space.candidates[c].family
        kinds = {space.candidates[o].family for o in best.chosen if o != c}
        if not space.candidates[c].named or family in kinds:
            continue
        for _, other in rivals(space, best, c, FAMILY_PENALTY):
            if space.candidates[other].named and space.candidates[other].family in kinds:
                others = tuple(o for o in best.chosen if o != c)
                return with_fewest_families(space, fit(space, (*others, other)))
    return best
