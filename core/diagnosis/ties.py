"""Ties: the effects that the data cannot separate from an accused one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gapbridge.core.diagnosis.criteria import SAME_SPAN, TIE_SCORE
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.delay_columns import delayed_by, exact_columns
from gapbridge.core.diagnosis.selection.local_search import rivals
from gapbridge.core.diagnosis.selection.sample_space import CandidateFit, SampleSpace, fit
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.estimation.least_squares import basis_of, projected_out


def ties_of(selection: Selection, accused: Sequence[int]) -> dict[int, tuple[str, ...]]:
    """Return, by accused candidate, the effects that fit as well in its place."""
    candidates = selection.space.candidates
    return {c: tuple(candidates[o].family for o in tied(selection, c)) for c in accused}


def tied(selection: Selection, c: int) -> list[int]:
    """Return the named candidates that fit as well in the place of ``c``, one of each effect.

    Another kind of delay has to do so at all joints, because they have one effect together.
    """
    if c in selection.block:  # the other links would take its part
        return equal_effects(selection, c)
    space, best = selection.working, selection.best
    kind = space.candidates[c].family
    nothing = fit(space, [o for o in best.chosen if o != c]).score
    near = [
        other for score, other in rivals(space, best, c, TIE_SCORE)
        if best.score + score < nothing and _fits_alone(selection, c, other)
    ]  # fmt: skip
    delayed = delayed_by(space, best)
    as_well = {name for name, f in delayed.items() if f.score <= best.score + TIE_SCORE}
    first: dict[str, int] = {}  # by effect
    for other in [*near, *equal_effects(selection, c)]:
        k = space.candidates[other]
        if not k.named or k.family == kind or k.effect.replaces == kind:  # a curve has its line
            continue
        if not (delayed and k.effect.is_delay and k.family not in as_well):
            first.setdefault(k.family, other)
    return list(first.values())


def _fits_alone(selection: Selection, c: int, other: int) -> bool:
    """Return whether a candidate that scales readings fits as well where ``c`` is not there.

    The space's columns are of the model with ``c``: the torque of a joint that does little but rub
    is its friction, and a scaled reading of it would pass for that friction.
    """
    rows = selection.excerpt or selection
    space, candidate = rows.working, rows.space.candidates[other]
    if not candidate.effect.scales_reading:
        return True
    own = space.candidates[c]
    base = [t for t in rows.base if (t.effect, t.site) != (own.family, own.site)]
    X = space.X.copy()
    X[:, space.start[other] : space.start[other + 1]] = rows.rows_of(
        exact_columns(rows.observation, candidate, base)
    )
    chosen = selection.best.chosen
    swapped = fit(replace(space, X=X), [*(o for o in chosen if o != c), other])
    return swapped.score <= fit(space, chosen).score + TIE_SCORE


def equal_effects(selection: Selection, c: int) -> list[int]:
    """Return the named candidates that equal ``c`` in this log whatever the noise."""
    equal = _equal_under_one_load(selection, c)
    if c in selection.block:
        return equal
    return covering_effects(selection.working, selection.best, c) + equal


def covering_effects(space: SampleSpace, best: CandidateFit, c: int) -> list[int]:
    """Return the named effects whose columns contain those of a candidate.

    The zero of the last joint is also a shift of the tool, and a heavier link 1 of an upright arm
    one whose centre of gravity is further out; the data cannot distinguish them.
    """
    others = basis_of(space.columns([o for o in best.chosen if o != c]))
    x = space.columns([c])
    x = projected_out(others, x)
    whole = float(np.sum(x**2))
    listed = []
    for other, k in enumerate(space.candidates):
        if other == c or other in best.chosen or not _geometric(k):
            continue
        basis = space.columns([other])
        basis = basis_of(projected_out(others, basis))
        if whole > 0 and float(np.sum(projected_out(basis, x) ** 2)) < SAME_SPAN * whole:
            listed.append(other)
    return listed


def _geometric(candidate: Candidate) -> bool:
    return candidate.named and (
        candidate.effect.estimated_with_links or candidate.effect.estimated_as_whole
    )


def _equal_under_one_load(selection: Selection, c: int) -> list[int]:
    """Return the last link's first moment for the load's centre of gravity, and the reverse.

    Where the load never changes they differ by the rotational inertia alone that either is assumed
    to move with it, and of a real hand that is not known.
    """
    observation = (selection.excerpt or selection).observation
    mass, candidates = observation.payload_mass, selection.space.candidates
    if mass is not None and np.ptp(mass) > 0:
        return []
    present = {"", *(candidates[o].family for o in selection.best.chosen)}
    listed = []
    for other, k in enumerate(candidates):
        for load, link in ((candidates[c], k), (k, candidates[c])):
            last = link.site.joint == len(observation.axes)
            if last and load.effect.equal_of_last_link == link.family and load.requires in present:
                listed.append(other)
    return listed
