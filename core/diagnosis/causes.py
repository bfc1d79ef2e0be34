"""Causes: accused effects with values and intervals, and the effects that are not accused."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum, auto

import numpy as np

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array, Mask
from gapbridge.core.diagnosis.criteria import MIN_EXCITATION, UNDETERMINED_SPREAD
from gapbridge.core.diagnosis.finding import ParameterNote, ParameterState, Withdrawal
from gapbridge.core.diagnosis.held_out import HeldOut, Shrink
from gapbridge.core.diagnosis.judgement import Judgement
from gapbridge.core.diagnosis.selection.forward_selection import joining
from gapbridge.core.diagnosis.selection.sample_space import CandidateFit, fit
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.effects import CATALOGUE, Reported, Term


@dataclass(frozen=True)
class Cause:
    """One accused effect, at all of its joints."""

    effect: str
    joints: tuple[int, ...]
    parameters: tuple[Reported, ...]
    shrink: Shrink | None
    shrink_alone: float | None
    probability: float
    indistinguishable_from: tuple[str, ...]
    terms: tuple[Term, ...]
    relative_deviation: tuple[float, ...]  # per term: least standard deviation over value
    notes: tuple[ParameterNote, ...] = ()


class Outcome(Enum):
    """Why an effect is not accused."""

    NOT_EXCITED = auto()  # the log cannot show it
    NOT_NEEDED = auto()  # explains too little in addition to the accused ones
    WITHDRAWN = auto()  # selected, but failed a check


@dataclass(frozen=True)
class Considered:
    """One effect of the catalogue that is not accused."""

    effect: str
    shrink_alone: float | None
    probability: float
    outcome: Outcome
    needs: str = ""  # NOT_EXCITED: what would excite it
    withdrawal: Withdrawal | None = None  # WITHDRAWN: the check that it failed

    @property
    def excited(self) -> bool:
        """Return whether the log can show the effect."""
        return self.outcome is not Outcome.NOT_EXCITED


def causes_of(
    selection: Selection, judgement: Judgement, held_out: HeldOut, arm: Arm,
    shown: Sequence[int] | None = None,
) -> tuple[Cause, ...]:  # fmt: skip
    """Return the accused effects, the one with the largest share of the gap first.

    ``shown`` are positions: only these are returned, evaluated together with all accused.
    """
    members: dict[str, list[int]] = {}
    for position in judgement.accused if shown is None else shown:
        members.setdefault(selection.terms[position].effect, []).append(position)
    all_accused = [selection.term_index[p] for p in judgement.accused]
    causes = [
        _cause(effect, sorted(positions, key=lambda p: selection.terms[p].site.joint or 0),
               all_accused, selection, judgement, held_out, arm)
        for effect, positions in members.items()
    ]  # fmt: skip
    return tuple(sorted(causes, key=lambda c: -(c.shrink.gap_without if c.shrink else 0.0)))


def _cause(
    effect: str, positions: list[int], all_accused: list[int], selection: Selection,
    judgement: Judgement, held_out: HeldOut, arm: Arm,
) -> Cause:  # fmt: skip
    members = {selection.term_index[p] for p in positions}
    others = [c for c in all_accused if c not in members]
    shrink = held_out.shrink(all_accused, others) if held_out.possible else None
    alone = held_out.shrink(sorted(members), ()).shrink if held_out.possible else None
    listed: list[Reported] = []
    notes: list[ParameterNote] = []
    relative = []
    for p in positions:
        term, covariance = selection.terms[p], selection.covariance[p]
        listed += CATALOGUE[effect].reported(arm, term, covariance)
        value, deviation = np.array(term.values), np.sqrt(np.maximum(np.diag(covariance), 0))
        size = np.abs(value[: len(deviation)])
        relative.append(float(np.min(np.where(deviation > 0, deviation, np.inf)
                                     / np.maximum(size, 1e-300))))  # fmt: skip
        notes += _at_bounds(effect, term, arm)
        nominal = selection.nominal.get(selection.term_index[p])
        notes += _not_identifiable(effect, term, deviation, arm, nominal)
    joints = sorted({t.site.joint for t in (selection.terms[p] for p in positions)
                     if t.site.joint is not None})  # fmt: skip
    ties = tuple(dict.fromkeys(n for p in positions for n in judgement.ties.get(p, ())))
    return Cause(
        effect, tuple(joints), tuple(listed), shrink, alone,
        probability(selection, members), ties,
        tuple(selection.terms[p] for p in positions), tuple(relative), tuple(notes),
    )  # fmt: skip


def _at_bounds(effect: str, term: Term, arm: Arm) -> list[ParameterNote]:
    notes = []
    for parameter, value in zip(
        CATALOGUE[effect].parameters(arm, term.site), term.values, strict=True
    ):
        if value in (parameter.lower, parameter.upper):
            name = CATALOGUE[effect].label(term.site, parameter)
            notes.append(ParameterNote(ParameterState.ON_BOUND, name, value, parameter.unit))
    return notes


def _not_identifiable(
    effect: str, term: Term, deviation: Array, arm: Arm, fixed: Mask | None
) -> list[ParameterNote]:
    """Return a note on each parameter that is not identifiable from these data."""
    notes = []
    nominal = np.zeros(len(deviation), dtype=bool) if fixed is None else fixed
    for parameter, value, spread, is_nominal in zip(
        CATALOGUE[effect].parameters(arm, term.site), term.values, deviation, nominal,
        strict=False,
    ):  # fmt: skip
        if spread == 0 or spread > UNDETERMINED_SPREAD * parameter.scale:
            name = CATALOGUE[effect].label(term.site, parameter)
            is_far = is_nominal and CATALOGUE[effect].estimated_as_whole
            state = ParameterState.NOMINAL if is_far else ParameterState.NOT_IDENTIFIABLE
            notes.append(ParameterNote(state, name, value, parameter.unit))
    return notes


def probability(selection: Selection, members: set[int]) -> float:
    """Return the probability that an effect is needed, against the best set without it."""
    best, space = selection.best, selection.working
    if members & set(selection.block):  # the search has compared these already
        return 1.0
    others = fit(space, tuple(c for c in best.chosen if c not in members))
    without = others.score
    families = {space.candidates[c].family for c in members}
    for score, c in joining(space, others.chosen, 12):
        if space.candidates[c].family not in families:
            without = min(without, score)
    odds = np.exp(-0.5 * min(max(without - best.score, 0.0), 700.0))
    return float(1 / (1 + odds))


def considered_of(
    selection: Selection, judgement: Judgement, held_out: HeldOut, withhold: Iterable[str] = ()
) -> tuple[Considered, ...]:
    """Return every effect of the channel that is not accused, with the reason."""
    space, channel = selection.working, selection.observation.channel
    accused = {selection.terms[p].effect for p in judgement.accused}
    kept = tuple(
        c for c in (selection.term_index[p] for p in judgement.accused) if c not in selection.block
    )
    base = fit(space, kept)
    reasons = {selection.terms[p].effect: why for p, why in judgement.withdrawn}
    listed = []
    for identifier, effect in CATALOGUE.items():
        if channel not in effect.channels or identifier in accused or identifier in withhold:
            continue
        variants = [c for c, k in enumerate(space.candidates) if k.family == identifier]
        # of usual size it may not show in a short log, but what was found did
        excited = identifier in reasons or any(_excited(selection, c) for c in variants)
        variants = _first_variants(selection, variants)
        if not variants or not excited:
            needs = effect.motion or ", ".join(effect.needs)
            listed.append(Considered(identifier, None, 0.0, Outcome.NOT_EXCITED, needs))
            continue
        tested = held_out.possible and len(variants) < 40
        alone = held_out.shrink(variants, ()).shrink if tested else None
        better = min(_score_with(selection, base, c) for c in variants)
        odds = float(np.exp(-0.5 * min(max(better - base.score, -700.0), 700.0)))
        withdrawal = reasons.get(identifier)
        outcome = Outcome.NOT_NEEDED if withdrawal is None else Outcome.WITHDRAWN
        listed.append(
            Considered(identifier, alone, odds / (1 + odds), outcome, withdrawal=withdrawal)
        )
    return tuple(listed)


def _first_variants(selection: Selection, variants: list[int]) -> list[int]:
    """Return one candidate per joint: periodic lines and curves have many variants."""
    seen: set[int | None] = set()
    first = []
    for c in variants:
        joint = selection.space.candidates[c].site.joint
        if joint not in seen:
            seen.add(joint)
            first.append(c)
    return first


def _excited(selection: Selection, c: int) -> bool:
    space = selection.space
    columns = space.columns([c]) * space.candidates[c].scales
    return bool(np.sqrt(np.sum(columns**2, axis=0)).max() > MIN_EXCITATION)


def _score_with(selection: Selection, base: CandidateFit, c: int) -> float:
    if c in base.chosen:
        return base.score
    return fit(selection.working, (*base.chosen, c)).score
