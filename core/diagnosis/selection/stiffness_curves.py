"""Stiffness curves: whether curved at all, and the straight ones as plain compliance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import CURVATURE_GAIN
from gapbridge.core.diagnosis.selection.problem import SampleSpace
from gapbridge.core.effects import CATALOGUE, Term
from gapbridge.core.estimation.least_squares import basis_of, projected_out


def straight_curves(
    space: SampleSpace,
    index: Sequence[int],
    terms: Sequence[Term],
    covariance: Sequence[Array],
    beside: Array | None = None,
) -> dict[int, int]:
    """Return the stiffness curves among candidates that a straight line fits as well, and that.

    By the likelihood, since a softening's sigma grows with it; one of less than its sigma is at its
    bound: what stiffens is no such curve. ``index`` gives the candidate of each term, ``beside``
    (m, d) stands beside all. Where axial compliance is no candidate, the curve stays.
    """
    further = space.X[:, :0] if beside is None else beside

    def misfit(candidates: Sequence[int]) -> float:
        basis = basis_of(np.hstack([space.columns(candidates), further]))
        rss = np.sum(projected_out(basis, space.y) ** 2)
        return float(space.misfit(np.asarray(rss)))

    straight: dict[int, int] = {}
    for c, term, spread in zip(index, terms, covariance, strict=True):
        effect = CATALOGUE[term.effect]
        lines = [
            other for other, k in enumerate(space.candidates)
            if k.family == effect.contains and k.site.joint == term.site.joint
        ]  # fmt: skip
        if not (effect.curved and lines):
            continue
        at_bound = term.values[1] <= float(np.sqrt(max(spread[1, 1], 0.0)))
        line = [lines[0] if other == c else other for other in index]
        if at_bound or misfit(line) - misfit(index) < CURVATURE_GAIN:
            straight[c] = lines[0]
    return straight


def with_straight_stiffness(
    space: SampleSpace,
    chosen: Sequence[int],
    index: Sequence[int],
    terms: Sequence[Term],
    covariance: Sequence[Array],
) -> tuple[int, ...] | None:
    """Return the set with straight curves as axial compliance, or None if there is none."""
    rest = [c for c in chosen if c not in set(index)]
    instead = straight_curves(space, index, terms, covariance, space.columns(rest))
    return tuple(instead.get(c, c) for c in chosen) if instead else None
