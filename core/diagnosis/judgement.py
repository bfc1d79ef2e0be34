"""The judgement: which selected terms are accused or withdrawn, and whether structure is left.

Each accused effect is validated by itself: its value is significant and off its bounds; it is
stable when the unnamed functions that the residual calls for are added (``value_stability``); and
it reduces the gap on held-out samples. Remaining structure is reported, but withdraws nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.constancy import not_constant
from gapbridge.core.diagnosis.criteria import (
    MAX_OUTLIER_SHARE,
    MAX_STRUCTURE_P,
    MAX_STRUCTURE_P_WITH_HINT,
    MIN_REPEATS_TO_TEST,
    NEGLIGIBLE_SIZE,
    OVER_INSTRUMENT_SIGMA,
    OVER_REPEAT_SCATTER,
    OVER_STATED_NOISE,
    SAME_SPAN,
    STAND_IN_GAIN,
    USUAL_REPEATABILITY,
)
from gapbridge.core.diagnosis.finding import Check, Withdrawal
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.periodicity import not_periodic
from gapbridge.core.diagnosis.regions import parts, single_pose
from gapbridge.core.diagnosis.residual_structure import dependence, structure_p_value
from gapbridge.core.diagnosis.selection.local_search import forward_selected
from gapbridge.core.diagnosis.selection.outliers import inliers
from gapbridge.core.diagnosis.selection.refit import UnnamedPart, worth
from gapbridge.core.diagnosis.selection.sample_space import CandidateFit, SampleSpace, fit
from gapbridge.core.diagnosis.selection.selection import Selection, refitted_alone
from gapbridge.core.diagnosis.selection.smooth import KNOTS
from gapbridge.core.diagnosis.selection.stiffness_curves import straight_curves
from gapbridge.core.diagnosis.ties import ties_of
from gapbridge.core.diagnosis.value_stability import (
    links_explain_gap,
    links_predict_new_regions,
    shifts_alike,
    stable_effects,
)
from gapbridge.core.effects import Parameter
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.least_squares import basis_of, projected_out

NOT_SIGNIFICANT = Withdrawal(Check.SIGNIFICANT)
NOT_STABLE = Withdrawal(Check.STABLE_VALUE)


@dataclass(frozen=True)
class Judgement:
    """The verdict on one channel."""

    accused: tuple[int, ...]  # positions in ``selection.terms``
    structured: bool
    p_value: float | None
    depends_on: tuple[tuple[str, float], ...]  # quantity, held-out share of the residual
    ties: dict[int, tuple[str, ...]]  # position -> effects that fit equally well
    withdrawn: tuple[tuple[int, Withdrawal], ...]  # position, reason
    unnamed_part: UnnamedPart | None = None  # unnamed functions for the residual structure
    undecided: tuple[int, ...] = ()  # positions to be decided on all rows
    stand_ins: tuple[int, ...] = ()  # positions not accused that reduce the gap in new regions


def judge(selection: Selection, held_out: HeldOut) -> Judgement:
    """Return the judgement of a selection."""
    withdrawn: dict[int, Withdrawal] = {}  # by candidate
    whole = selection
    if selection.block and not links_predict_new_regions(selection):
        withdrawn |= dict.fromkeys(selection.block, NOT_STABLE)
        selection = selection.without_links()
    for position, reason in _insignificant(selection).items():
        withdrawn[selection.term_index[position]] = reason
    withdrawn |= dict.fromkeys(not_periodic(selection), Withdrawal(Check.NOT_LOCALISED))
    for c, others in _confounded_at_one_orientation(selection).items():
        withdrawn[c] = Withdrawal(Check.SEPARATED, others)  # more rows would not separate them
    for c, quantity in _confounded_with_level(selection).items():
        withdrawn.setdefault(c, Withdrawal(Check.NOT_A_LEVEL, quantity))
    tested = [
        c for c in selection.term_index if c not in withdrawn and c not in selection.block
    ]  # fmt: skip
    accused, unnamed_part, closing = stable_effects(selection, tested)
    varying = not_constant(selection, accused, unnamed_part.columns)
    while closing & varying.keys():  # a varying term closed the gap: try without it
        withdrawn |= {c: Withdrawal(Check.CONSTANT, by) for c, by in varying.items()}
        tested = [c for c in tested if c not in varying]
        accused, unnamed_part, closing = stable_effects(selection, tested)
        varying = not_constant(selection, accused, unnamed_part.columns)
    withdrawn |= {c: NOT_STABLE for c in tested if c not in accused}
    for c, quantity in varying.items():
        withdrawn[c] = Withdrawal(Check.CONSTANT, quantity)
        accused.remove(c)
    for c in _missing_requirement(selection, accused):
        withdrawn[c] = Withdrawal(Check.COMPANION)
        accused.remove(c)
    withdrawn_any = bool(withdrawn)
    accused = [*accused, *selection.block]
    for c in without_gain(selection, accused, held_out):
        withdrawn[c] = Withdrawal(Check.HELD_OUT_GAIN)
        accused.remove(c)
    judgement = _verdict(whole, selection, accused, withdrawn, withdrawn_any)
    unknown = judgement.structured or unnamed_part.columns.shape[1] > 0
    # positions in motion: neighbours in time share their errors, whatever these are
    unknown |= selection.observation.channel == "position" and selection.observation.order_in_time
    return replace(judgement, unnamed_part=unnamed_part if unknown else None)


def judge_geometry(
    selection: Selection, judgement: Judgement, arm: Arm
) -> tuple[Selection, Judgement]:
    """Return selection and judgement with all links' geometry accused, where it explains the gap.

    It is tried where part of the geometry is suspected and structure is left.
    """
    if selection.observation.channel != "position":
        return selection, judgement
    accused_before = [selection.term_index[p] for p in judgement.accused]
    suspected = [*accused_before, *(selection.term_index[p] for p, _ in judgement.withdrawn)]
    shifts = shifts_alike(selection)
    effects = [selection.space.candidates[c].effect for c in suspected if c not in shifts]
    geometric = any(e.estimated_as_whole or e.estimated_with_links for e in effects)
    if selection.block or not (geometric and judgement.structured):
        return selection, judgement
    try:
        whole = selection.with_all_links(arm)
    except InputError:  # such an arm has no equilibrium
        return selection, judgement
    if whole is None or not links_explain_gap(whole, selection, accused_before):
        return selection, judgement
    second_judgement = judge(whole, HeldOut(whole))
    accused = {whole.term_index[p] for p in second_judgement.accused}
    return (whole, second_judgement) if accused & set(whole.block) else (selection, judgement)


def _verdict(
    whole: Selection, selection: Selection, accused: list[int],
    withdrawn: Mapping[int, Withdrawal], withdrawn_any: bool,
) -> Judgement:  # fmt: skip
    """Return the judgement with the ``accused`` candidates, and whether structure is left."""
    position_of = {c: p for p, c in enumerate(whole.term_index)}
    nuisance = selection.nuisance_basis
    single = [c for c in accused if c not in selection.block]
    space = _space_left_by(selection, single)
    p_value = structure_p_value(space, nuisance, single)
    p_value = min(p_value, _excess_residual_p(whole))
    if _outlier_share(whole, accused) > MAX_OUTLIER_SHARE:
        p_value = 0.0
    unnamed = any(not space.candidates[c].named for c in selection.best.chosen)
    if unnamed:
        p_value = min(p_value, _unnamed_unnecessary_p(selection.working, selection.best))
    hint = unnamed or withdrawn_any
    structured = p_value < (MAX_STRUCTURE_P_WITH_HINT if hint else MAX_STRUCTURE_P)
    depends: tuple[tuple[str, float], ...] = ()
    if structured or not accused:
        # a constant that is not separated from a load depends on nothing, whatever predicts it
        constant = [c for c, why in withdrawn.items() if why.failed is Check.SEPARATED]
        known = [*single, *constant]
        if not constant or structure_p_value(space, nuisance, known) < MAX_STRUCTURE_P:
            depends = tuple(dependence(space, nuisance, known, selection.groups))
    ties = ties_of(selection, accused)
    return Judgement(
        tuple(position_of[c] for c in accused), structured, p_value, depends,
        {position_of[c]: names for c, names in ties.items()},
        tuple((position_of[c], why) for c, why in withdrawn.items()),
    )  # fmt: skip


def _predicted(selection: Selection, accused: Sequence[int]) -> Array:
    """Return the observation's prediction (N, k) with the terms of the accused candidates."""
    pairs = zip(selection.term_index, selection.terms, strict=True)
    return selection.observation.predict([term for c, term in pairs if c in accused])


def _space_left_by(selection: Selection, accused: Sequence[int]) -> SampleSpace:
    """Return the working space with the residual of the accused terms as its target.

    The space's own target is of the model that it is linearised at, which may hold other terms.
    Where all links are a cause they are a part of its noise, and its target is kept.
    """
    if selection.block:
        return selection.working
    residual = selection.observation.measured - _predicted(selection, accused)
    return replace(selection.space, y=selection.plain_rows_of(residual[..., None])[:, 0])


def _outlier_share(selection: Selection, accused: Sequence[int]) -> float:
    """Return the share of the samples that are outliers and that the accused terms do not fit."""
    left_out, observation = ~selection.kept, selection.observation
    if np.mean(left_out) > MAX_OUTLIER_SHARE:
        residual = observation.measured - _predicted(selection, accused)
        left_out &= ~inliers(observation, selection.noise, residual)
    return float(np.mean(left_out))


def with_structure_left(selection: Selection, judgement: Judgement) -> Judgement:
    """Return the judgement with the structure that its accused terms leave.

    For a judgement of more terms, some of which have been withdrawn since.
    """
    accused = [selection.term_index[p] for p in judgement.accused]
    if not set(accused) & set(selection.block):
        selection = selection.without_links()
    single = [c for c in accused if c not in selection.block]
    space, nuisance = _space_left_by(selection, single), selection.nuisance_basis
    p_value = structure_p_value(space, nuisance, single)
    if judgement.p_value is not None:
        p_value = min(p_value, judgement.p_value)
    structured = judgement.structured or p_value < MAX_STRUCTURE_P_WITH_HINT
    depends = judgement.depends_on
    if structured or not accused:
        depends = tuple(dependence(space, nuisance, single, selection.groups))
    return replace(judgement, p_value=p_value, structured=structured, depends_on=depends)


def _unnamed_unnecessary_p(space: SampleSpace, best: CandidateFit) -> float:
    """Return the probability that a set does not need its unnamed functions."""
    named = fit(space, [c for c in best.chosen if space.candidates[c].named])
    alone = forward_selected(space, named, named_only=True)
    return float(1 / (1 + np.exp(0.5 * np.clip(alone.score - best.score, -700.0, 700.0))))


def _insignificant(selection: Selection) -> dict[int, Withdrawal]:
    """Return positions of terms that are on a bound, negligible or not significant."""
    withdrawn = {}
    straight = straight_curves(
        selection.space, selection.term_index, selection.terms, selection.covariance
    )
    for position, (c, term) in enumerate(zip(selection.term_index, selection.terms, strict=True)):
        if c in selection.block:
            continue
        candidate, spread = selection.space.candidates[c], selection.covariance[position]
        if c in straight:
            withdrawn[position] = Withdrawal(Check.CURVED)
        if candidate.curve is None and any(
            _on_bound(p, v, candidate.effect.adds_up or candidate.effect.adds_mass)
            for p, v in zip(candidate.parameters, term.values, strict=False)
        ):
            withdrawn[position] = Withdrawal(Check.INSIDE_BOUNDS)
        if worth(term, spread) < 1:
            withdrawn[position] = NOT_SIGNIFICANT
        least = NEGLIGIBLE_SIZE * candidate.scales
        if candidate.curve is None and all(
            abs(v) < size for v, size in zip(term.values, least, strict=False)
        ):
            withdrawn[position] = Withdrawal(Check.USUAL_SIZE)
    return withdrawn


def _on_bound(parameter: Parameter, value: float, may_be_gone: bool) -> bool:
    """Return whether a value is on a bound, and so unknown.

    Of what adds up, as of a load, a lower bound below zero is what the model holds: it is gone.
    """
    below, above = abs(value - parameter.lower), abs(value - parameter.upper)
    if may_be_gone and parameter.lower < 0:
        below = np.inf
    return min(below, above) < 1e-6 * parameter.scale


def significant_alone(
    selection: Selection, judgement: Judgement, held_out: HeldOut, arm: Arm
) -> tuple[Selection, Judgement]:
    """Return selection and judgement after the accused terms are refitted alone.

    With unnamed functions, and with covariances over the regions of the log, a value may be less
    significant than before, and a stiffness curve linear. If all links are accused as a whole, no
    parameter may be implausible without being significant.
    What gained held out beside terms that are withdrawn here must gain without them, and what
    gained with a parameter that is held nominal here without it.
    """
    start, complete, whole = selection.terms, judgement.accused, selection
    while True:
        refit = refitted_alone(selection, arm, judgement.accused, judgement.unnamed_part, start)
        if implausible := refit.implausible_parameters(judgement.accused):
            selection = selection.with_nominal(implausible)
            continue
        unknown = judgement.unnamed_part is not None
        straight = refit.linear_curves(judgement.accused) if unknown else {}
        if lines := {p: line for p, line in straight.items() if line is not None}:
            selection = selection.with_lines(lines)
            anew = judge(selection, HeldOut(selection))
            out = {p for p, _ in judgement.withdrawn}
            withdrawn = tuple((p, why) for p, why in anew.withdrawn if p not in out)
            judgement = replace(
                anew, accused=tuple(p for p in anew.accused if p not in out),
                withdrawn=(*judgement.withdrawn, *withdrawn), stand_ins=judgement.stand_ins,
            )  # fmt: skip
            start = selection.terms
            continue
        significance = {
            p: 0.0 if p in straight else worth(refit.terms[p], refit.covariance[p])
            for p in judgement.accused
        }
        alone = refit.judged_alone(judgement.accused)
        weakest = tuple(sorted(alone, key=lambda p: significance[p])[:1])
        if weakest and significance[weakest[0]] < 1:
            inside = refit.term_index[weakest[0]] in refit.block
            # friction that belongs to the links may be significant on more rows
            reason = NOT_SIGNIFICANT if inside else NOT_STABLE
        else:
            accused = [refit.term_index[p] for p in judgement.accused]
            if selection is not whole:
                whole, held_out, complete = selection, HeldOut(refit), ()
            again = judgement.accused != complete
            gainless = without_gain(refit, accused, held_out) if again else ()
            weakest = tuple(p for p in judgement.accused if refit.term_index[p] in gainless)
            if not weakest:
                return refit, judgement
            reason = Withdrawal(Check.HELD_OUT_GAIN)
        judgement = replace(
            judgement, accused=tuple(p for p in judgement.accused if p not in weakest),
            withdrawn=(*judgement.withdrawn, *((p, reason) for p in weakest)),
            ties={p: names for p, names in judgement.ties.items() if p not in weakest},
        )  # fmt: skip
        start = refit.terms


def _missing_requirement(selection: Selection, accused: Sequence[int]) -> list[int]:
    """Return the candidates whose required effect is not accused."""
    candidates = selection.space.candidates
    families = {"", *(candidates[c].family for c in accused)}
    return [c for c in accused if candidates[c].requires not in families]


def _confounded_at_one_orientation(selection: Selection) -> dict[int, str]:
    """Return terms that are a constant reading on this log, with the names of their rivals.

    While the flange does not turn against gravity, a weight, and what scales it, is a constant: a
    sensor's constant is not separated from a load, nor any of them from a sensor's constant.
    """
    space, rivals_of = selection.working, {}
    constants = [c for c, k in enumerate(space.candidates) if k.effect.fits_any_constant]
    for constant in constants:
        basis = basis_of(space.columns([constant]))
        alike = [
            c for c, candidate in enumerate(space.candidates)
            if c != constant and candidate.named and _is_within(basis, space.columns([c]))
        ]  # fmt: skip
        loads = [c for c in alike if space.candidates[c].effect.loads_joints]
        for c in selection.term_index:
            if c == constant and loads:
                names = [space.candidates[other].family for other in loads]
                rivals_of[c] = " or ".join(dict.fromkeys(names))
            elif c in alike:
                rivals_of[c] = space.candidates[constant].family
    return rivals_of


def _is_within(basis: Array, x: Array) -> bool:
    """Return whether columns (m, k) are combinations of an orthonormal basis (m, b)."""
    whole = float(np.sum(x**2))
    return whole > 0 and float(np.sum(projected_out(basis, x) ** 2)) < SAME_SPAN * whole


def _confounded_with_level(selection: Selection) -> dict[int, str]:
    """Return steps at which a quantity changes level that an unnamed function depends on too.

    A tool that seats differently under each load is no target slip at a change of load.
    """
    observation, quantity_of = selection.observation, {}
    goes_by = dict.fromkeys(
        k.quantity for c in selection.best.chosen
        if (k := selection.space.candidates[c]).quantity
    )  # fmt: skip
    for c, term in zip(selection.term_index, selection.terms, strict=True):
        if observation.times is None or not selection.space.candidates[c].effect.at_moment:
            continue
        after = observation.times > term.values[-1]
        for name in goes_by:
            z = observation.quantities[name]
            if len(np.unique(z)) <= KNOTS and not np.isin(z[after], z[~after]).any():
                quantity_of[c] = name
    return quantity_of


def without_gain(
    selection: Selection, accused: Sequence[int], held_out: HeldOut, *, each: bool = False
) -> list[int]:
    """Return the candidates of effects that do not reduce the held-out gap, the weakest first.

    First moments, friction and offsets of all joints count as one effect, of which few rows show
    only what it gains as a whole; ``each``: every effect has to gain by itself.
    """
    if not held_out.possible:
        return list(accused)
    remaining, failed = list(accused), []
    while remaining:
        by_effect = _by_effect(selection, remaining, each)
        low = {
            kind: held_out.shrink(remaining, [c for c in remaining if c not in members]).interval[0]
            for kind, members in by_effect.items()
        }
        worst = min(low, key=lambda kind: low[kind])
        if low[worst] > 0:
            break
        failed += by_effect[worst]
        remaining = [c for c in remaining if c not in by_effect[worst]]
    return failed


def _by_effect(selection: Selection, chosen: Sequence[int], each: bool) -> dict[str, list[int]]:
    by_effect: dict[str, list[int]] = {}
    for c in chosen:
        whole = not each and c in selection.block and selection.observation.channel != "position"
        by_effect.setdefault("" if whole else selection.space.candidates[c].family, []).append(c)
    return by_effect


def with_stand_ins(selection: Selection, judgement: Judgement) -> Judgement:
    """Return the judgement with the stand-ins: terms not accused that help in new regions.

    Terms are removed one by one, the least useful first, until each remaining one helps.
    """
    index, none = selection.term_index, _insignificant(selection)
    useful = [
        p for p, why in judgement.withdrawn if p not in none and why.failed is not Check.SEPARATED
    ]
    held_out = HeldOut(selection, parts=parts(selection.observation, selection.kept))
    if not (useful and held_out.possible) or single_pose(selection.observation):
        return judgement
    chosen = [*judgement.accused, *useful]
    groups = _groups(selection, useful)
    while groups:
        everything = [index[p] for p in chosen]
        others = [[index[p] for p in chosen if p not in group] for group in groups]
        worst = min(range(len(groups)), key=lambda u: held_out.rms(others[u]))
        if held_out.shrink(everything, others[worst]).interval[0] > STAND_IN_GAIN:
            break
        removed = groups.pop(worst)
        chosen = [p for p in chosen if p not in removed]
    stand_ins = tuple(sorted(p for group in groups for p in group))
    return replace(judgement, stand_ins=stand_ins)


def _groups(selection: Selection, positions: Sequence[int]) -> list[tuple[int, ...]]:
    """Return each position by itself, those of the links' geometry as one group."""
    links = tuple(p for p in positions if selection.term_index[p] in selection.block)
    single: list[tuple[int, ...]] = [(p,) for p in positions if p not in links]
    return [*single, links] if links else single


def _excess_residual_p(selection: Selection) -> float:
    """Return the p-value of the residual's size under noise alone; 1 if it is not too large.

    The noise is the stated one, that of repeats, or the usual one of instruments.
    """
    observation, k = selection.observation, selection.observation.measured.shape[1]
    if observation.sigma <= 0 or observation.channel != "position":
        return 1.0
    residual = selection.residual[selection.kept][:, : min(k, 3)]
    freedom = max(residual.size - selection.used, 1.0)
    variance = float(np.sum(residual**2)) / freedom
    session = None if observation.session is None else observation.session[selection.kept]
    pure, repeats = pure_error(residual, observation.groups[selection.kept], session)
    if observation.sigma_is_whole:
        least, times = observation.sigma**2, OVER_STATED_NOISE
    elif repeats >= MIN_REPEATS_TO_TEST and not observation.order_in_time:
        least, times = max(pure, observation.sigma**2), OVER_REPEAT_SCATTER
    else:
        least, times = max(USUAL_REPEATABILITY, OVER_INSTRUMENT_SIGMA * observation.sigma) ** 2, 1.0
    if variance <= times**2 * least:
        return 1.0
    from scipy.special import gammaincc  # slow to import

    return float(gammaincc(freedom / 2, freedom * variance / least / 2))


def pure_error(
    residual: Array, groups: NDArray[np.int64], session: NDArray[np.int64] | None = None
) -> tuple[float, int]:
    """Return the variance of one coordinate among repeats of a pose, and its degrees of freedom.

    Repeats under other loads count too: the residual of a good model does not depend on them.
    Those of other sessions do not: each session has a frame of its own, in error by itself.
    """
    total, freedom = 0.0, 0
    if session is not None:
        groups = np.unique(np.column_stack([groups, session]), axis=0, return_inverse=True)[1]
        groups = groups.reshape(-1)
    for group in np.unique(groups):
        part = residual[groups == group]
        if len(part) > 1:
            total += float(np.sum((part - part.mean(axis=0)) ** 2))
            freedom += (len(part) - 1) * residual.shape[1]
    return total / max(freedom, 1), freedom
