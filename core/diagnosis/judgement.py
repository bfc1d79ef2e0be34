"""The judgement: what is accused, what is withdrawn, and what is said to be unexplained.

An accusation stands or falls by itself: it has a value, off its bounds; it withstands the unnamed
functions that the residual asks for (``remainder``); and it shrinks the gap on samples that its fit
did not see. That something else is left takes nothing back; it is said.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.bump import bumps
from gapbridge.core.diagnosis.constancy import not_constant
from gapbridge.core.diagnosis.criteria import (
    CURVATURE_GAIN,
    HINT_P,
    NEGLIGIBLE,
    OUTLIER_SHARE,
    OVER_INSTRUMENT_SIGMA,
    OVER_REPEAT_SCATTER,
    OVER_STATED_NOISE,
    REPEATS_REFUTE,
    SAME_SPAN,
    STAND_IN_GAIN,
    SURE_P,
    TIE_SCORE,
    USUAL_REPEATABILITY,
)
from gapbridge.core.diagnosis.finding import Check, Withdrawal
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.regions import one_place, parts
from gapbridge.core.diagnosis.remainder import (
    closes_everywhere,
    links_withstand,
    withstanding,
)
from gapbridge.core.diagnosis.residual_structure import (
    dependence,
    structure_p_value,
)
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.delay_columns import delayed_by
from gapbridge.core.diagnosis.selection.local_search import forward_selected, rivals
from gapbridge.core.diagnosis.selection.problem import CandidateFit, SampleSpace, fit
from gapbridge.core.diagnosis.selection.refit import Remainder, worth
from gapbridge.core.diagnosis.selection.selection import Selection, refitted_alone
from gapbridge.core.diagnosis.selection.smooth import KNOTS
from gapbridge.core.diagnosis.selection.stiffness_curves import straight_curves
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.least_squares import basis_of, projected_out

VAGUE = Withdrawal(Check.SIGNIFICANT)
BESIDE = Withdrawal(Check.STABLE_VALUE)


@dataclass(frozen=True)
class Judgement:
    """The verdict on one channel."""

    accused: tuple[int, ...]  # positions in ``selection.terms``
    structured: bool
    p_value: float | None
    depends_on: tuple[
        tuple[str, float], ...
    ]  # quantity, held-out share of what is not accounted for
    ties: dict[int, tuple[str, ...]]  # position -> effects that would do as well
    withdrawn: tuple[tuple[int, Withdrawal], ...]  # position, reason
    remainder: Remainder | None = None  # unnamed functions that account for what is left
    vague: tuple[int, ...] = ()  # positions that some rows leave vague: all rows decide
    stand_ins: tuple[
        int, ...
    ] = ()  # positions not accused that shrink the gap in regions not fitted


def judge(selection: Selection, held: HeldOut) -> Judgement:
    """Return the judgement of a selection."""
    withdrawn: dict[int, Withdrawal] = {}  # by candidate
    whole = selection
    if selection.block and not links_withstand(selection):
        withdrawn |= dict.fromkeys(selection.block, BESIDE)
        selection = selection.without_links()
    for position, reason in _no_value(selection).items():
        withdrawn[selection.term_index[position]] = reason
    withdrawn |= dict.fromkeys(bumps(selection), Withdrawal(Check.NOT_LOCALISED))
    for c, loads in _like_a_load(selection).items():
        withdrawn.setdefault(c, Withdrawal(Check.SEPARATED, loads))
    for c, quantity in _like_a_level(selection).items():
        withdrawn.setdefault(c, Withdrawal(Check.NOT_A_LEVEL, quantity))
    believed = [
        c for c in selection.term_index if c not in withdrawn and c not in selection.block
    ]  # fmt: skip
    stays, remainder, closing = withstanding(selection, believed)
    varying = not_constant(selection, stays, remainder.columns)
    while closing & varying.keys():  # what closed the gap varies: another may do it in its place
        withdrawn |= {c: Withdrawal(Check.CONSTANT, by) for c, by in varying.items()}
        believed = [c for c in believed if c not in varying]
        stays, remainder, closing = withstanding(selection, believed)
        varying = not_constant(selection, stays, remainder.columns)
    withdrawn |= {c: BESIDE for c in believed if c not in stays}
    for c, quantity in varying.items():
        withdrawn[c] = Withdrawal(Check.CONSTANT, quantity)
        stays.remove(c)
    for c in _without_companion(selection, stays):
        withdrawn[c] = Withdrawal(Check.COMPANION)
        stays.remove(c)
    fallen = bool(withdrawn)
    stays = [*stays, *selection.block]
    for c in gainless(selection, stays, held):
        withdrawn[c] = Withdrawal(Check.HELD_OUT_GAIN)
        stays.remove(c)
    judgement = _verdict(whole, selection, stays, withdrawn, fallen)
    unknown = judgement.structured or remainder.columns.shape[1] > 0
    return replace(judgement, remainder=remainder if unknown else None)


def judge_geometry(
    selection: Selection, judgement: Judgement, arm: Arm
) -> tuple[Selection, Judgement]:
    """Return selection and judgement with all links' geometry accused, where one link is not it.

    What the accusations leave it has to close in every part of the log, each predicted by a fit
    that did not see it.
    """
    accused_before = [selection.term_index[p] for p in judgement.accused]
    suspected = [*accused_before, *(selection.term_index[p] for p, _ in judgement.withdrawn)]
    single = any(selection.space.candidates[c].effect.together for c in suspected)
    if selection.block or not (single and judgement.structured):
        return selection, judgement
    try:
        whole = selection.with_all_links(arm)
    except InputError:  # no arm of such links stands
        return selection, judgement
    if whole is None or not closes_everywhere(whole, accused_before):
        return selection, judgement
    again = judge(whole, HeldOut(whole))
    accused = {whole.term_index[p] for p in again.accused}
    return (whole, again) if accused & set(whole.block) else (selection, judgement)


def _verdict(
    whole: Selection, selection: Selection, stays: list[int],
    withdrawn: Mapping[int, Withdrawal], fallen: bool,
) -> Judgement:  # fmt: skip
    """Return the judgement of what stays of a whole selection, and whether structure is left."""
    place = {c: p for p, c in enumerate(whole.term_index)}
    space, nuisance = selection.working, selection.nuisance_basis
    single = [c for c in stays if c not in selection.block]
    p_value = structure_p_value(space, nuisance, single)
    p_value = min(p_value, _too_much_left(whole))
    if np.mean(~whole.kept) > OUTLIER_SHARE:  # no bad luck: something befalls the log
        p_value = 0.0
    unnamed = any(not space.candidates[c].named for c in selection.best.chosen)
    if unnamed:
        p_value = min(p_value, _needless(space, selection.best))
    structured = p_value < (HINT_P if unnamed or fallen else SURE_P)
    depends: tuple[tuple[str, float], ...] = ()
    if structured or not stays:
        depends = tuple(dependence(space, nuisance, single, selection.groups))
    ties = ties_of(space, selection.best, single)
    return Judgement(
        tuple(place[c] for c in stays), structured, p_value, depends,
        {place[c]: names for c, names in ties.items()},
        tuple((place[c], why) for c, why in withdrawn.items()),
    )  # fmt: skip


def _needless(space: SampleSpace, best: CandidateFit) -> float:
    """Return the probability that named causes alone would do, of a set with unnamed functions."""
    named = fit(space, [c for c in best.chosen if space.candidates[c].named])
    alone = forward_selected(space, named, named_only=True)
    return float(1 / (1 + np.exp(0.5 * np.clip(alone.score - best.score, -700.0, 700.0))))


def _no_value(selection: Selection) -> dict[int, Withdrawal]:
    """Return positions of terms that only a bound holds, or whose value may as well be none."""
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
            min(abs(v - p.lower), abs(v - p.upper)) < 1e-6 * p.scale
            for p, v in zip(candidate.parameters, term.values, strict=False)
        ):
            withdrawn[position] = Withdrawal(Check.INSIDE_BOUNDS)
        if worth(term, spread) < 1:
            withdrawn[position] = VAGUE
        least = NEGLIGIBLE * candidate.scales
        if candidate.curve is None and all(
            abs(v) < size for v, size in zip(term.values, least, strict=False)
        ):
            withdrawn[position] = Withdrawal(Check.USUAL_SIZE)
    return withdrawn


def still_sure(selection: Selection, judgement: Judgement, arm: Arm) -> tuple[Selection, Judgement]:
    """Return what is accused refitted as all there is, and its judgement.

    Beside the unknown, and over the regions of the log, a value may be less sure than it was, and a
    stiffness curve straight. Of the links, accused as a whole, one term at least must be sure by
    itself: else the data show none of their numbers; and none may be far off without being sure.
    """
    while True:
        refit = refitted_alone(selection, arm, judgement.accused, judgement.remainder)
        if far := refit.far_off(judgement.accused):
            selection = selection.with_nominal(far)
            continue
        straight = _straight_beside(refit, judgement)
        share = {
            p: 0.0 if p in straight else worth(refit.terms[p], refit.covariance[p])
            for p in judgement.accused
        }
        weakest = min(
            refit.judged_together(judgement.accused),
            key=lambda kind: max(share[p] for p in kind), default=(),
        )  # fmt: skip
        if not weakest or max(share[p] for p in weakest) >= 1:
            return refit, judgement
        inside = refit.term_index[weakest[0]] in refit.block
        # of friction beside the links more rows may still be sure
        reason = VAGUE if inside else BESIDE
        # a joint's zero among the links that shows nothing leaves nothing behind
        structured = not inside or refit.is_link(weakest[0])
        judgement = replace(
            judgement, accused=tuple(p for p in judgement.accused if p not in weakest),
            withdrawn=(*judgement.withdrawn, *((p, reason) for p in weakest)),
            structured=judgement.structured or structured,
            ties={p: names for p, names in judgement.ties.items() if p not in weakest},
        )  # fmt: skip


def _straight_beside(refit: Selection, judgement: Judgement) -> set[int]:
    """Return positions of accused stiffness curves that are straight beside the unknown.

    By their sigma over the regions of the log: what scatters among regions has no likelihood.
    """
    return {
        p for p in judgement.accused
        if judgement.remainder is not None and CATALOGUE[refit.terms[p].effect].curved
        and refit.terms[p].values[1] ** 2 < CURVATURE_GAIN * refit.covariance[p][1, 1]
    }  # fmt: skip


def _without_companion(selection: Selection, stays: Sequence[int]) -> list[int]:
    """Return the candidates that show nothing without an effect that is not accused beside them."""
    candidates = selection.space.candidates
    families = {"", *(candidates[c].family for c in stays)}
    return [c for c in stays if candidates[c].beside not in families]


def _like_a_load(selection: Selection) -> dict[int, str]:
    """Return the constants of a sensor of which a load's weight is one, too, and which load's.

    As long as the flange does not turn against gravity a weight is a constant reading.
    """
    space, loads_of = selection.working, {}
    for c in selection.term_index:
        if not space.candidates[c].effect.any_constant:
            continue
        U = basis_of(space.columns([c]))
        alike = []
        for other, candidate in enumerate(space.candidates):
            if not candidate.effect.carried:
                continue
            x = space.columns([other])
            whole = float(np.sum(x**2))
            if whole > 0 and float(np.sum(projected_out(U, x) ** 2)) < SAME_SPAN * whole:
                alike.append(candidate.family)
        if alike:
            loads_of[c] = " or ".join(dict.fromkeys(alike))
    return loads_of


def _like_a_level(selection: Selection) -> dict[int, str]:
    """Return what steps as a quantity leaves all its levels that something unnamed goes by, too.

    A tool that seats differently under each load is no target that moves as one is changed.
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


def gainless(selection: Selection, stays: Sequence[int], held: HeldOut) -> list[int]:
    """Return the candidates of effects that do not shrink the held-out gap, the weakest first."""
    if not held.possible:
        return list(stays)
    staying, fallen = list(stays), []
    while staying:
        kinds = _by_effect(selection, staying)
        low = {
            kind: held.shrink(staying, [c for c in staying if c not in members]).interval[0]
            for kind, members in kinds.items()
        }
        worst = min(low, key=lambda kind: low[kind])
        if low[worst] > 0:
            break
        fallen += kinds[worst]
        staying = [c for c in staying if c not in kinds[worst]]
    return fallen


def _by_effect(selection: Selection, chosen: Sequence[int]) -> dict[str, list[int]]:
    kinds: dict[str, list[int]] = {}
    for c in chosen:
        whole = c in selection.block
        kinds.setdefault("" if whole else selection.space.candidates[c].family, []).append(c)
    return kinds


def with_stand_ins(selection: Selection, judgement: Judgement) -> Judgement:
    """Return the judgement with what is not accused, but shrinks the gap in regions not fitted.

    Terms go one by one, the least useful first, until each of those left gains.
    """
    index, none = selection.term_index, _no_value(selection)
    useful = [
        p for p, why in judgement.withdrawn if p not in none and why.failed is not Check.SEPARATED
    ]
    held = HeldOut(selection, parts=parts(selection.observation, selection.kept))
    if not (useful and held.possible) or one_place(selection.observation):
        return judgement
    chosen = [*judgement.accused, *useful]
    units = _units(selection, useful)
    while units:
        everything = [index[p] for p in chosen]
        rest = [[index[p] for p in chosen if p not in unit] for unit in units]
        worst = min(range(len(units)), key=lambda u: held.rms(rest[u]))
        if held.shrink(everything, rest[worst]).interval[0] > STAND_IN_GAIN:
            break
        gone = units.pop(worst)
        chosen = [p for p in chosen if p not in gone]
    stand_ins = tuple(sorted(p for unit in units for p in unit))
    return replace(judgement, stand_ins=stand_ins)


def _units(selection: Selection, positions: Sequence[int]) -> list[tuple[int, ...]]:
    """Return the positions each by itself, the links' geometry in one."""
    links = tuple(p for p in positions if selection.term_index[p] in selection.block)
    single: list[tuple[int, ...]] = [(p,) for p in positions if p not in links]
    return [*single, links] if links else single


def _too_much_left(selection: Selection) -> float:
    """Return the probability that noise leaves as much as is left; 1 unless that is too much.

    Against the noise that is stated, or that repeats show, or that instruments usually have.
    """
    observation, k = selection.observation, selection.observation.measured.shape[1]
    if observation.sigma <= 0 or observation.channel != "position":
        return 1.0
    residual = selection.residual[selection.kept][:, : min(k, 3)]
    freedom = max(residual.size - selection.used, 1.0)
    variance = float(np.sum(residual**2)) / freedom
    pure, repeats = pure_error(residual, observation.groups[selection.kept])
    if observation.sigma_is_whole:
        least, times = observation.sigma**2, OVER_STATED_NOISE
    elif repeats >= REPEATS_REFUTE:
        least, times = max(pure, observation.sigma**2), OVER_REPEAT_SCATTER
    else:
        least, times = max(USUAL_REPEATABILITY, OVER_INSTRUMENT_SIGMA * observation.sigma) ** 2, 1.0
    if variance <= times**2 * least:
        return 1.0
    from scipy.special import gammaincc  # a fifth of a second, only where too much is left

    return float(gammaincc(freedom / 2, freedom * variance / least / 2))


def pure_error(residual: Array, groups: NDArray[np.int64]) -> tuple[float, int]:
    """Return the variance of one coordinate among repeats of a pose, and its degrees of freedom.

    Repeats under other loads count too: the residual of a good model does not depend on them.
    """
    total, freedom = 0.0, 0
    for group in np.unique(groups):
        part = residual[groups == group]
        if len(part) > 1:
            total += float(np.sum((part - part.mean(axis=0)) ** 2))
            freedom += (len(part) - 1) * residual.shape[1]
    return total / max(freedom, 1), freedom


def ties_of(
    space: SampleSpace, best: CandidateFit, accused: Sequence[int]
) -> dict[int, tuple[str, ...]]:
    """Return the effects that would do as well as each accused one, at its place.

    Another delay has to do so at all joints: they have one effect together.
    """
    listed: dict[int, tuple[str, ...]] = {}
    delayed = delayed_by(space, best)
    as_well = {name for name, f in delayed.items() if f.score <= best.score + TIE_SCORE}
    for c in accused:
        kind = space.candidates[c].family
        near = [other for _, other in rivals(space, best, c, TIE_SCORE)]
        names: list[str] = []
        for other in [*near, *covering_effects(space, best, c)]:
            family = space.candidates[other].family
            if not space.candidates[other].named or family in (kind, *names):
                continue
            if delayed and space.candidates[other].effect.delays and family not in as_well:
                continue
            if space.candidates[other].effect.contains != kind:  # a curve holds its line: no rival
                names.append(family)
        listed[c] = tuple(names)
    return listed


def covering_effects(space: SampleSpace, best: CandidateFit, c: int) -> list[int]:
    """Return the named effects that do all that a candidate does, and more: nothing decides.

    The zero of the last joint is a shift of the tool, and a heavier link 1 of an upright arm one
    whose centre of gravity is further out; each is the simpler guess, and no surer.
    """
    rest = basis_of(space.columns([o for o in best.chosen if o != c]))
    x = space.columns([c])
    x = projected_out(rest, x)
    whole = float(np.sum(x**2))
    listed = []
    for other, k in enumerate(space.candidates):
        if other == c or other in best.chosen or not _geometric(k):
            continue
        U = space.columns([other])
        U = basis_of(projected_out(rest, U))
        if whole > 0 and float(np.sum(projected_out(U, x) ** 2)) < SAME_SPAN * whole:
            listed.append(other)
    return listed


def _geometric(candidate: Candidate) -> bool:
    return candidate.named and (candidate.effect.beside_links or candidate.effect.together)
