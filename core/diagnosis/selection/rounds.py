"""The search in rounds, each linearised at the model found so far, until it converges.

Each round searches among linear columns, refits the selected terms on the full prediction, and
estimates noise and outliers again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.diagnosis.criteria import (
    CONTAINED_SHARE,
    LARGE_SAMPLE,
    MAX_PAYLOAD_FACTOR,
    NEGLIGIBLE_WORTH,
    UNDETERMINED_SPREAD,
)
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.selection.candidate import (
    Candidate,
    joint_quantity,
    named_candidates,
    with_requirement,
)
from gapbridge.core.diagnosis.selection.delay_columns import exact_columns, one_delay
from gapbridge.core.diagnosis.selection.geometry import links_of, with_links
from gapbridge.core.diagnosis.selection.local_search import forward_selected, pruned
from gapbridge.core.diagnosis.selection.noise import Noise, estimate_noise
from gapbridge.core.diagnosis.selection.outliers import (
    mark_outliers,
    readmit_explained_outliers,
    revise_noise_and_outliers,
)
from gapbridge.core.diagnosis.selection.refit import refit, worth
from gapbridge.core.diagnosis.selection.sample_space import CandidateFit, SampleSpace, fit
from gapbridge.core.diagnosis.selection.search import screened_search, weighted_by_residual
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.diagnosis.selection.smooth import CandidateColumns, smooth_candidates, unnamed
from gapbridge.core.diagnosis.selection.state import (
    SelectionState,
    UnprojectedRows,
    candidate_of,
    flat,
    sample_space,
)
from gapbridge.core.diagnosis.selection.step_times import step_candidates
from gapbridge.core.diagnosis.selection.stiffness_curves import with_straight_stiffness
from gapbridge.core.effects import Parameter, Site, Term
from gapbridge.core.estimation.least_squares import basis_of, projected_out, solve
from gapbridge.core.load_bounds import LoadBounds
from gapbridge.core.model import Model

ROUNDS = 8


def select(
    observation: Observation,
    model: Model,
    withheld: Iterable[str] = (),
    progress: Callable[[str], None] | None = None,
) -> Selection:
    """Return the best explanation of an observation by named effects and unnamed functions."""
    kept = np.ones(len(observation.rows), dtype=bool)
    first = estimate_noise(observation, observation.measured - observation.predict(()), kept)
    state = SelectionState(observation, model.arm, [], first, kept)
    base: tuple[Term, ...] = ()
    smooth_pairs = smooth_candidates(observation)
    excluded: set[tuple[str, Site]] = set()  # effects removed by the nonlinear refit
    result: _Round | None = None
    for iteration in range(ROUNDS):
        if progress:
            progress(f"{observation.channel}: round {iteration + 1}")
        result = None  # frees the memory of its columns
        result = _round(state, model, base, withheld, excluded, smooth_pairs, iteration == 0)
        same_terms = terms_alike(result.terms, base) and iteration > 0
        converged = same_terms and bool((result.state.kept == result.fitted_samples).all())
        state, base, space = result.state, result.terms, result.space
        # values fitted together with an unnamed function are not final, but a term of negligible
        # worth (the scale of a torque that is zero) may block another
        named_only = all(space.candidates[c].named for c in result.best.chosen)
        weakest = result.weakest(1.0 if converged and named_only else NEGLIGIBLE_WORTH)
        if weakest is not None:
            excluded.add((base[weakest].effect, base[weakest].site))
            base = base[:weakest] + base[weakest + 1 :]
        elif converged:
            break
    assert result is not None
    space = result.space
    of_joints = observation.channel in ("tracking", "torque")
    if (of_joints or len(space.y) >= LARGE_SAMPLE) and any(
        not space.candidates[c].named for c in result.best.chosen
    ):
        result = _named_refit(result)
    return Selection(
        result.state.observation, space, result.best, result.terms, result.index,
        result.covariance, result.fitted_samples, result.fit_noise, result.residual, base,
        result.unprojected, result.links,
    )  # fmt: skip


@dataclass(frozen=True)
class _Round:
    """The result of one round of the search."""

    state: SelectionState  # with noise and outliers of the round's residual
    fitted_samples: Mask  # (N,) samples that were fitted
    fit_noise: Noise
    space: SampleSpace
    search_space: SampleSpace  # the same, whitened by the links where they are a cause
    unprojected: UnprojectedRows
    links: dict[int, Array]
    best: CandidateFit
    terms: tuple[Term, ...]
    index: tuple[int, ...]
    covariance: tuple[Array, ...]
    residual: Array

    def weakest(self, least: float) -> int | None:
        """Return the position of the least significant term if below ``least``; links excluded.

        Terms of which no parameter is identifiable come first.
        """
        share = {}
        for p, c in enumerate(self.index):
            if c not in self.links:
                size = self.space.candidates[c].scales
                sigma = np.sqrt(np.diag(self.covariance[p]))
                spread = float((sigma / size[: len(sigma)]).min()) / UNDETERMINED_SPREAD
                share[p] = -spread if spread > 1 else worth(self.terms[p], self.covariance[p])
        weakest = min(share, key=lambda p: share[p], default=None)
        return None if weakest is None or share[weakest] >= least else weakest


def _round(
    state: SelectionState, model: Model, base: tuple[Term, ...], withheld: Iterable[str],
    excluded: set[tuple[str, Site]], smooth_pairs: list[CandidateColumns], first: bool,
) -> _Round:  # fmt: skip
    """Return a round: search at the model with ``base``, nonlinear refit, noise and outliers."""
    named = _named_candidates(state.observation, model, withheld, base)
    named_open = [c for c in named if (c.family, c.site) not in excluded]
    state = replace(state, candidates=named_open)
    columns = [exact_columns(state.observation, c, base) for c in named_open]
    if first:  # rows after a late slip would be outliers of a model without it
        steps = step_candidates(state, columns, base, withheld)
        state = mark_outliers(state, [*zip(named_open, columns, strict=True), *steps])
    smooth = _without_known_loads(smooth_pairs, named_open, columns, base)
    stepping = step_candidates(state, columns, base, withheld)
    state = replace(state, candidates=[*named_open, *(candidate for candidate, _ in stepping)])
    columns += [step_columns for _, step_columns in stepping]
    space, unprojected = sample_space(state, columns, base, smooth)
    in_model = [candidate_of(state.candidates, t)[0] for t in base]
    # of positions: an M1013 lost its flexibilities by it (1.28 mm on judged poses, not 0.82)
    exchange = state.observation.channel != "position"
    best = one_delay(space, screened_search(space, in_model, exchange=exchange))
    if not first and not state.kept.all():
        state, space, unprojected, best = readmit_explained_outliers(
            state, columns, base, smooth, (space, unprojected, best)
        )
    search_space, best, links = with_links(space, best, in_model)
    fitted_samples, fit_noise = state.kept, state.noise
    exact = _refit_set(search_space, best, state)
    state, terms, index, covariance, residual = refit(state, space, exact, links)
    straight = with_straight_stiffness(space, best.chosen, index, terms, covariance)
    if straight is not None:
        best = pruned(search_space, fit(search_space, straight))
        state, terms, index, covariance, residual = refit(state, space, best, links)
    used = sum(len(v) for v in best.values) + (links_of(space, links).used if links else 0)
    noise_residual = _without_smooth_part(state, space, best, smooth, residual)
    state = revise_noise_and_outliers(state, noise_residual, 1 - used / space.freedom)
    return _Round(
        state, fitted_samples, fit_noise, space, search_space, unprojected, links, best, terms,
        index, covariance, residual,
    )  # fmt: skip


def _named_refit(result: _Round) -> _Round:
    """Return a round with its named terms refitted alone; the set keeps its unnamed functions."""
    links, space = result.links, result.space
    state = replace(result.state, kept=result.fitted_samples, noise=result.fit_noise)
    named_fit, best = _without_unnamed(result.search_space, result.best, state.observation)
    while True:
        state, terms, index, covariance, residual = refit(state, space, named_fit, links)
        result = replace(
            result, state=state, best=best, terms=terms, index=index, covariance=covariance,
            residual=residual,
        )  # fmt: skip
        weakest = result.weakest(NEGLIGIBLE_WORTH)
        if weakest is None:
            return result
        named_fit, best = (
            fit(result.search_space, [c for c in fitted.chosen if c != index[weakest]])
            for fitted in (named_fit, best)
        )


def _without_known_loads(
    smooth: list[CandidateColumns], candidates: Sequence[Candidate], columns: Sequence[Array],
    base: Sequence[Term],
) -> list[CandidateColumns]:  # fmt: skip
    """Return the smooth candidates, unnamed loads without the columns of loads in the model.

    A mass anywhere at the tool is a payload with a centre of gravity, a pull downwards a weight. In
    a set with these an unnamed load would only take over their values.
    """
    in_model_effects = {t.effect for t in base}
    loads = [
        own.reshape(-1, own.shape[-1])
        for c, own in zip(candidates, columns, strict=True)
        if c.effect.loads_joints and not c.site.joint and in_model_effects & {c.family, c.requires}
    ]
    if not loads:
        return smooth
    U, remaining = basis_of(np.hstack(loads)), []
    for c, own in smooth:
        if c.without_quantity:
            X = basis_of(own.reshape(len(U), -1))
            _, share, V = np.linalg.svd(projected_out(U, X), full_matrices=False)
            new = share**2 > 1 - CONTAINED_SHARE
            if not new.any():
                continue
            if not new.all():
                others = (X @ V[new].T).reshape(*own.shape[:2], -1)
                remaining.append(unnamed("", c.target, others))
                continue
        remaining.append((c, own))
    return remaining


def _named_candidates(
    observation: Observation, model: Model, withheld: Iterable[str], base: tuple[Term, ...]
) -> list[Candidate]:
    """Return the named candidates that are observable, with bounds, at a model's terms."""
    turns = [
        float(np.ptp(observation.quantities.get(joint_quantity(observation, i), np.zeros(1))))
        / (2 * np.pi)
        for i in range(model.arm.n)
    ]
    rotation = observation.measured.shape[1] > 3
    return [
        with_requirement(observation, bounded(c, model, observation))
        for c in named_candidates(model.arm, observation.channel, withheld, rotation, base, turns)
        if _observable(c, observation)
    ]


def _without_unnamed(
    space: SampleSpace, best: CandidateFit, observation: Observation
) -> tuple[CandidateFit, CandidateFit]:
    """Return the named part of a set, fitted without its unnamed functions and with them.

    The model has to predict without the unnamed functions, and these may hide a named cause
    (friction of the same joint). If each coordinate is a joint, each is weighted by its residual,
    because an unknown effect at one joint says nothing of the causes at others.
    """
    named = [c for c in best.chosen if space.candidates[c].named]
    search_space = space
    if observation.channel in ("tracking", "torque"):
        search_space = weighted_by_residual(space, named, observation.measured.shape[1])
    grown = forward_selected(search_space, fit(search_space, named), named_only=True)
    named_fit = pruned(search_space, grown).chosen
    others = (c for c in best.chosen if c not in named)
    return fit(space, named_fit), fit(space, (*named_fit, *others))


def _refit_set(space: SampleSpace, best: CandidateFit, state: SelectionState) -> CandidateFit:
    """Return the part of a set that is refitted; in tracking only named effects.

    There an unnamed function would absorb the error of the first linearisation, so that delays and
    lags would not converge to the values without it.
    """
    if state.observation.channel != "tracking":
        return best
    return fit(space, [c for c in best.chosen if space.candidates[c].named])


def _without_smooth_part(
    state: SelectionState,
    space: SampleSpace,
    best: CandidateFit,
    smooth: list[tuple[Candidate, Array]],
    residual: Array,
) -> Array:
    """Return the residual (N, k) without the part that the set's unnamed functions explain.

    That part is no noise. In a large log of poses the residual of the named causes alone is
    returned.
    """
    named = len(state.candidates)
    columns = [smooth[c - named][1] for c in best.chosen if c >= named]
    poses = state.observation.channel == "position" and len(space.y) >= LARGE_SAMPLE
    if not columns or poses:
        return residual
    both = np.concatenate([*columns, state.observation.nuisance], axis=2)
    rows, target = flat(both, state), flat(residual[..., None], state)[:, 0]
    return np.asarray(residual - both @ solve(rows, target))


def _observable(candidate: Candidate, observation: Observation) -> bool:
    if candidate.periodic:  # of a joint that moves at all
        assert candidate.site.joint is not None
        return joint_quantity(observation, candidate.site.joint - 1) in observation.quantities
    return all(
        any(q == need or q.startswith(f"{need}_") for q in observation.quantities)
        for need in candidate.effect.needs
        if need != "approach"  # without reversals backlash is tied with an offset
    )


def terms_alike(a: tuple[Term, ...], b: tuple[Term, ...]) -> bool:
    """Return whether two sets of terms accuse the same effects at the same sites."""
    return {(t.effect, t.site) for t in a} == {(t.effect, t.site) for t in b}


def bounded(candidate: Candidate, model: Model, observation: Observation) -> Candidate:
    """Return the candidate with bounds that keep the total of model and term physical.

    Values are real minus model: of what the model holds already, less is possible too. Of a
    stiffness curve the bound of the flexibility holds for the sum of its two parts.
    """
    effect, shown = candidate.effect, len(candidate.parameters)
    if effect.adds_mass:
        least, most = payload_bounds(model, observation)
        mass = replace(candidate.parameters[0], lower=least, upper=most)
        return replace(candidate, parameters=(mass, *candidate.parameters[1:]))
    if effect.adds_up:
        whole = _without_model(candidate, model)
    elif effect.flexibility:
        whole = candidate.parameters
    else:
        return candidate
    if effect.flexibility or effect.has_nonlinearity:
        axial, radial = model.compliance()
        compliance = radial if effect.flexibility == "radial" else axial
        lower = -float(compliance[candidate.site.index])
        whole = (replace(whole[0], lower=lower), *whole[1:])
    if candidate.curve is None:
        return replace(candidate, parameters=whole[:shown], whole=whole)
    first = replace(candidate.parameters[0], lower=whole[0].lower)
    return replace(candidate, parameters=(first, *candidate.parameters[1:]), whole=whole)


def _without_model(candidate: Candidate, model: Model) -> tuple[Parameter, ...]:
    """Return all parameters of a candidate's effect, bounds less what the model holds of each."""
    parameters = candidate.effect.parameters(model.arm, candidate.site)
    own = [
        t.values for t in model.terms if (t.effect, t.site) == (candidate.family, candidate.site)
    ]
    held = np.sum(own, axis=0) if own else np.zeros(len(parameters))
    return tuple(
        replace(p, lower=p.lower - float(v), upper=max(p.upper - float(v), 0.0))
        for p, v in zip(parameters, held, strict=True)
    )


def payload_bounds(model: Model, observation: Observation) -> tuple[float, float]:
    """Return bounds of a payload's error: every true mass is from 0 to the largest plausible."""
    declared = observation.payload_mass
    if declared is None:
        declared = np.array([model.payload_mass])
    least, most = (float(m) + model.added_mass for m in (declared.min(), declared.max()))
    largest = MAX_PAYLOAD_FACTOR * max(float(declared.max()), LoadBounds.of(model).rated)
    return -max(least, 0.0), max(largest - most, 0.0)
