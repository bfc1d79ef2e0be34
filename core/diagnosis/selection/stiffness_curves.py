"""Stiffness curves: whether curved at all, and the straight ones as plain compliance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import CURVATURE_GAIN
from gapbridge.core.diagnosis.selection.problem import SampleSpace
from gapbridge.core.effects import CATALOGUE, Term


def without_curvature(terms: Sequence[Term], covariance: Sequence[Array]) -> list[int]:
    """Return positions of stiffness curves that a straight line would fit as well."""
    straight = []
    for position, (term, spread) in enumerate(zip(terms, covariance, strict=True)):
        if not CATALOGUE[term.effect].curved:
            continue
        softening, deviation = term.values[1], float(np.sqrt(max(spread[1, 1], 0)))
        if softening <= 0 or softening < np.sqrt(CURVATURE_GAIN) * deviation:
            straight.append(position)
    return straight


def with_straight_stiffness(
    space: SampleSpace,
    chosen: Sequence[int],
    index: Sequence[int],
    terms: Sequence[Term],
    covariance: Sequence[Array],
) -> tuple[int, ...] | None:
    """Return the set with straight curves as axial compliance, or None if there is none.

    ``index`` gives the candidate of each term. Where axial compliance is no candidate, the curve
    stays.
    """
    instead: dict[int, int] = {}
    for position in without_curvature(terms, covariance):
        joint, straight = terms[position].site.joint, CATALOGUE[terms[position].effect].contains
        for c, candidate in enumerate(space.candidates):
            if candidate.family == straight and candidate.site.joint == joint:
                instead[index[position]] = c
    return tuple(instead.get(c, c) for c in chosen) if instead else None
