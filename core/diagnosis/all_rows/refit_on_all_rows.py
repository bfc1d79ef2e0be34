"""Validation on all rows: the terms found by a search on some rows are refitted on all of them.

A search needs thousands of columns and uses a part of a long log. The few selected candidates and
their rivals fit into memory for all rows, which decide values, ties and held-out gains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from gapbridge.core.arrays import Mask
from gapbridge.core.diagnosis.constancy import not_constant
from gapbridge.core.diagnosis.criteria import MIN_SIGMAS, MIN_SIGMAS_WITH_UNNAMED, TIE_SCORE
from gapbridge.core.diagnosis.finding import Check, Withdrawal
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.judgement import (
    NOT_SIGNIFICANT,
    Judgement,
    without_gain,
)
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.regions import regions
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.delay_columns import exact_columns
from gapbridge.core.diagnosis.selection.geometry import links_of
from gapbridge.core.diagnosis.selection.local_search import rivals
from gapbridge.core.diagnosis.selection.noise import carried_to
from gapbridge.core.diagnosis.selection.outliers import inliers
from gapbridge.core.diagnosis.selection.refit import (
    LinearisedTerms,
    UnnamedPart,
    linearised_terms,
    refit,
    worth,
)
from gapbridge.core.diagnosis.selection.sample_space import fit
from gapbridge.core.diagnosis.selection.selection import Selection, refitted_alone
from gapbridge.core.diagnosis.selection.state import SelectionState, sample_space
from gapbridge.core.diagnosis.ties import equal_effects, ties_of
from gapbridge.core.effects import CATALOGUE, Term
from gapbridge.core.estimation.least_squares import solve
from gapbridge.core.estimation.robust import start_weights
from gapbridge.core.model import Model


class Refits(Protocol):
    """How the selection's terms are refitted on all rows."""

    def alone(self, selection: Selection, accused: Sequence[int]) -> Selection:
        """Return the selection with some of its terms (positions), refitted without the others."""

    def linearised(self, selection: Selection, accused: Sequence[int]) -> LinearisedTerms | None:
        """Return the regression about the accused terms' values; None: each set is refitted."""


MAX_RIVALS = 12  # of all causes together
NO_GAIN = Withdrawal(Check.ALL_ROWS_GAIN)


def with_undecided_terms(judgement: Judgement) -> Judgement:
    """Return the judgement with terms accused that were not significant on some rows."""
    undecided = tuple(p for p, why in judgement.withdrawn if why == NOT_SIGNIFICANT)
    return replace(
        judgement, accused=(*judgement.accused, *undecided), undecided=undecided,
        withdrawn=tuple((p, why) for p, why in judgement.withdrawn if p not in undecided),
    )  # fmt: skip


def fitted_on_all_rows(
    selection: Selection, judgement: Judgement, whole: Observation, model: Model
) -> Selection:
    """Return the selection with its accused terms refitted on ``whole``.

    Its space has the named terms, at their positions, and the rivals of the accused. If there is
    an unnamed part, covariances include the scatter among regions.
    """
    accused = judgement.accused
    candidates = [
        _shaped_as(selection.space.candidates[c], term)
        for c, term in zip(selection.term_index, selection.terms, strict=True)
    ]
    candidates += _rivals(selection, accused)
    terms = tuple(selection.terms[p] for p in accused)
    placed = _placed(whole, terms)
    noise = carried_to(placed, selection.noise)
    state = SelectionState(
        placed, model.arm, candidates, noise, np.ones(len(placed.rows), dtype=bool)
    )
    state = replace(state, kept=inliers(placed, noise, placed.measured - placed.predict(terms)))
    columns = [exact_columns(placed, c, terms) for c in candidates]
    space, unprojected = sample_space(state, columns, terms, [])
    links = {p: selection.prior[c] for p, c in enumerate(selection.term_index)
             if c in selection.prior and p in accused}  # fmt: skip
    near = links_of(space, links).whitened_space(space, links) if links else space
    linear = fit(near, tuple(p for p in accused if p not in links))
    unnamed_part = None if judgement.unnamed_part is None else _scatter(placed, state.kept)
    state, fitted, index, spread, residual = refit(state, space, linear, links, unnamed_part)
    values, covariance = list(selection.terms), list(selection.covariance)
    for c, term, term_covariance in zip(index, fitted, spread, strict=True):
        values[c], covariance[c] = term, term_covariance
    return Selection(
        state.observation, space, linear, tuple(values), tuple(range(len(values))),
        tuple(covariance), state.kept, noise, residual, terms, unprojected, links,
    )  # fmt: skip


def _scatter(observation: Observation, kept: Mask) -> UnnamedPart:
    """Return the regions for covariances by scatter, without unnamed functions."""
    region = np.repeat(regions(observation, kept), observation.measured.shape[1])
    return UnnamedPart(np.zeros((len(region), 0)), np.zeros(0), region)


def _shaped_as(candidate: Candidate, term: Term) -> Candidate:
    """Return the candidate with the shape of the term's last refit."""
    if not candidate.effect.start_values:
        return candidate
    return replace(candidate, fixed=(*candidate.fixed[:-1], term.values[-1]))


def accused_on_all_rows(
    selection: Selection, judgement: Judgement, held_out: HeldOut, refits: Refits
) -> tuple[Selection, Judgement]:
    """Return selection and judgement of the effects that are validated on all rows.

    Values have to be significant, lines constant over the quarters of the joint's range, and each
    effect has to reduce the held-out gap. Ties are evaluated again. ``refits`` refits some of the
    selection's terms.
    """
    selection, judgement = _significant(selection, judgement, refits)
    varying = {
        p: Withdrawal(Check.CONSTANT, by)
        for p, by in not_constant(selection, judgement.accused).items()
    }
    selection, judgement = _without(varying, selection, judgement, refits)
    # in the space of all rows a term's position is its candidate
    failed: list[int] = []
    if held_out.possible:
        failed = without_gain(selection, judgement.accused, held_out, each=True)
    selection, judgement = _without(dict.fromkeys(failed, NO_GAIN), selection, judgement, refits)
    return selection, replace(judgement, ties=ties_of(selection, judgement.accused))


def without_causes(judgement: Judgement, depends_on: tuple[tuple[str, float], ...]) -> Judgement:
    """Return the judgement of causes with which the gap of all rows is larger than without them."""
    return replace(
        judgement, accused=(), structured=True, p_value=0.0, depends_on=depends_on,
        withdrawn=(*judgement.withdrawn, *((p, NO_GAIN) for p in judgement.accused)),
    )  # fmt: skip


def _without(
    reasons: Mapping[int, Withdrawal], selection: Selection, judgement: Judgement, refits: Refits
) -> tuple[Selection, Judgement]:
    """Return selection and judgement without some positions, the others refitted and significant.

    (Without its lines, a UR10's links took lengths of 55 mm that were not significant.)
    """
    if not reasons:
        return selection, judgement
    accused = tuple(p for p in judgement.accused if p not in reasons)
    judgement = replace(
        judgement, accused=accused, withdrawn=(*judgement.withdrawn, *reasons.items())
    )
    return _significant(refits.alone(selection, accused), judgement, refits)


def _significant(
    selection: Selection, judgement: Judgement, refits: Refits
) -> tuple[Selection, Judgement]:
    """Return selection and judgement with significant terms only; undecided ones need six sigmas.

    Of the links, accused as a whole, no parameter may be implausible without being significant.
    """
    link_terms = {p for p in judgement.accused if p in selection.prior}  # three sigmas suffice
    square = (MIN_SIGMAS_WITH_UNNAMED / MIN_SIGMAS) ** 2
    least = dict.fromkeys(set(judgement.undecided) - link_terms, square)
    while True:
        accused = judgement.accused
        if far := selection.implausible_parameters(accused):
            selection = refits.alone(selection.with_nominal(far), accused)
            continue
        removed = _insignificant(selection, accused, least, refits)
        if not removed:
            return selection, judgement
        judgement = replace(
            judgement, accused=tuple(p for p in accused if p not in removed),
            withdrawn=(*judgement.withdrawn, *((p, NOT_SIGNIFICANT) for p in removed)),
        )  # fmt: skip
        selection = refits.alone(selection, judgement.accused)


def _insignificant(
    selection: Selection, accused: Sequence[int], least: Mapping[int, float], refits: Refits
) -> list[int]:
    """Return the positions of terms to remove, the weakest first; ``least`` is 1 of others.

    Terms that came to zero, on their bound, are removed together, since the others' values do not
    depend on them. What the removal changes is followed to first order. (A torque constant of 0.94
    that was not significant took the friction of a UR10e's joint with it.)
    """
    strength = {p: worth(selection.terms[p], selection.covariance[p]) for p in accused}
    removed: list[int] = []
    linearised = None
    while True:
        left = [p for p in accused if p not in removed]
        weak = [p for p in selection.judged_alone(left) if strength[p] < least.get(p, 1.0)]
        if not weak:
            return removed
        gains = [p for p in weak if _scales_reading(selection.terms[p])]
        if gains:  # its joint's other values scale with it: first, and never to first order
            return removed or gains[:1]
        # what came back for all rows to decide goes first, before what it replaces
        doubtful = [p for p in weak if p in least] or weak
        at_zero = [p for p in doubtful if not strength[p]]
        removed += at_zero or [min(doubtful, key=lambda p: strength[p])]
        left = [p for p in left if p not in removed]
        linearised = linearised or refits.linearised(selection, accused)
        if linearised is None or not left:
            return removed
        fits = linearised.alone([accused.index(p) for p in left])
        strength = {
            p: worth(selection.terms[p].with_values(value), spread)
            for p, value, spread in zip(left, *fits, strict=True)
        }


def _scales_reading(term: Term) -> bool:
    return CATALOGUE[term.effect].scales_reading


@dataclass(frozen=True)
class RefitsAtOnce:
    """Refits on all rows at once. If something is unknown, covariances include regions' scatter."""

    model: Model
    unknown: bool

    def alone(self, selection: Selection, accused: Sequence[int]) -> Selection:
        """Return the selection with some of its terms (positions), refitted without the others."""
        whole = refitted_alone(selection, self.model.arm, accused, self._scatter(selection))
        links = {p: own for p, own in whole.prior.items() if p in accused}
        whole = replace(whole, prior=links)
        single = tuple(p for p in accused if p not in links)
        return replace(whole, best=fit(whole.working, single))

    def linearised(self, selection: Selection, accused: Sequence[int]) -> LinearisedTerms | None:
        """Return the regression about the accused terms' values.

        Links keep the prior that they have with all of them. None for a cell whose own parameters
        are uncertain.
        """
        observation, scatter = selection.observation, self._scatter(selection)
        if observation.uncertain is not None:
            return None
        state = SelectionState(observation, self.model.arm, [], selection.noise, selection.kept)
        return linearised_terms(
            state, [selection.space.candidates[p] for p in accused],
            [selection.terms[p] for p in accused], [selection.prior.get(p) for p in accused],
            None if scatter is None else scatter.region, selection.space.floor,
        )  # fmt: skip

    def _scatter(self, selection: Selection) -> UnnamedPart | None:
        return _scatter(selection.observation, selection.kept) if self.unknown else None


def _rivals(selection: Selection, accused: Sequence[int]) -> list[Candidate]:
    """Return the named candidates that tie with an accused one on the searched rows."""
    space = selection.working
    near: dict[int, float] = {}
    for p in accused:
        c = selection.term_index[p]
        scored = [(0.0, other) for other in equal_effects(selection, c)]
        if c not in selection.prior:
            scored += rivals(space, selection.best, c, TIE_SCORE)
        for score, other in scored:
            if space.candidates[other].named and other not in selection.term_index:
                near[other] = min(score, near.get(other, np.inf))
    best = sorted(near, key=lambda c: near[c])[:MAX_RIVALS]
    return [space.candidates[c] for c in best]


def _placed(whole: Observation, terms: Sequence[Term]) -> Observation:
    """Return the observation with its frames fitted, given the terms."""
    if whole.rebase is None:
        return whole
    gap = whole.measured - whole.predict(terms)
    weight = whole.weight[: gap.shape[1]]
    A, b = (whole.nuisance * weight[:, None]).reshape(gap.size, -1), gap * weight
    row = np.repeat(start_weights(b), gap.shape[1])
    return whole.rebased(solve(A * row[:, None], b.ravel() * row), terms)
