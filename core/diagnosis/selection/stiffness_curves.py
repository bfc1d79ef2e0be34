"""Stiffness curves: the nonlinearity test; linear ones are replaced by axial compliance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import CURVATURE_GAIN
from gapbridge.core.diagnosis.selection.sample_space import SampleSpace
from gapbridge.core.effects import CATALOGUE, Term
from gapbridge.core.estimation.least_squares import basis_of, projected_out


def straight_curves(
    space: SampleSpace,
    index: Sequence[int],
    terms: Sequence[Term],
    covariance: Sequence[Array],
    further: Array | None = None,
) -> dict[int, int]:
    """Return the stiffness curves that are linear, and the axial compliance of each.

    By the likelihood, because a softening's sigma grows with its value. A softening below its sigma
    is at its bound (the joint stiffens). ``index`` gives the candidate of each term, ``further``
    (m, d) are other columns in the fit. Without axial compliance as a candidate the curve is kept.
    """
    others = space.X[:, :0] if further is None else further

    def misfit(candidates: Sequence[int]) -> float:
        basis = basis_of(np.hstack([space.columns(candidates), others]))
        rss = np.sum(projected_out(basis, space.y) ** 2)
        return float(space.misfit(np.asarray(rss)))

    straight: dict[int, int] = {}
    for c, term, spread in zip(index, terms, covariance, strict=True):
        effect = CATALOGUE[term.effect]
        lines = [
            other for other, k in enumerate(space.candidates)
            if k.family == effect.replaces and k.site.joint == term.site.joint
        ]  # fmt: skip
        if not (effect.has_nonlinearity and lines):
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
    """Return the set with linear curves as axial compliance, or None if there is none."""
    others = [c for c in chosen if c not in set(index)]
    instead = straight_curves(space, index, terms, covariance, space.columns(others))
    return tuple(instead.get(c, c) for c in chosen) if instead else None
