"""The search, in rounds: around the model with what was found, until it finds the same again.

Each round searches among linear columns, refits exactly what it found, and looks anew at noise
and outliers.
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
from gapbridge.core.diagnosis.selection.geometry import (
    links_of,
    with_links,
)
from gapbridge.core.diagnosis.selection.local_search import forward_selected, pruned
from gapbridge.core.diagnosis.selection.moments import step_candidates
from gapbridge.core.diagnosis.selection.noise import Noise, estimate_noise
from gapbridge.core.diagnosis.selection.outliers import (
    mark_outliers,
    readmit_explained_outliers,
    revise_noise_and_outliers,
)
from gapbridge.core.diagnosis.selection.problem import CandidateFit, SampleSpace, fit
from gapbridge.core.diagnosis.selection.refit import refit, worth
from gapbridge.core.diagnosis.selection.search import screened_search, weighted_by_residual
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.diagnosis.selection.smooth import Pair, smooth_candidates, unnamed
from gapbridge.core.diagnosis.selection.state import (
    SelectionState,
    UnprojectedRows,
    candidate_of,
    flat,
    sample_space,
)
from gapbridge.core.diagnosis.selection.stiffness_curves import with_straight_stiffness
from gapbridge.core.effects import Site, Term
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
    """Return the best explanation of an observation by named effects and smooth functions."""
    kept = np.ones(len(observation.rows), dtype=bool)
    first = estimate_noise(observation, observation.measured - observation.predict(()), kept)
    state = SelectionState(observation, model.arm, [], first, kept)
    base: tuple[Term, ...] = ()
    offered = smooth_candidates(observation)
    none: set[tuple[str, Site]] = set()  # what the exact refit takes back: its place is free
    last: _Round | None = None
    for turn in range(ROUNDS):
        if progress:
            progress(f"{observation.channel}: round {turn + 1}")
        last = None  # its columns are as large as the new ones: not both at a time
        last = _round(state, model, base, withheld, none, offered, turn == 0)
        same = terms_alike(last.terms, base) and turn > 0
        settled = same and bool((last.state.kept == last.fitted_samples).all())
        state, base, space = last.state, last.terms, last.space
        # beside an unnamed function a value is not yet what it comes to without; but what shows
        # nothing by itself (the scale of a torque that is not there) keeps the place of what does
        named_only = all(space.candidates[c].named for c in last.best.chosen)
        weakest = last.weakest(1.0 if settled and named_only else NEGLIGIBLE_WORTH)
        if weakest is not None:
            none.add((base[weakest].effect, base[weakest].site))
            base = base[:weakest] + base[weakest + 1 :]
        elif settled:
            break
    assert last is not None
    space = last.space
    if len(space.y) >= LARGE_SAMPLE and any(
        not space.candidates[c].named for c in last.best.chosen
    ):
        last = _named_refit(last)
    return Selection(
        last.state.observation, space, last.best, last.terms, last.index, last.covariance,
        last.fitted_samples, last.fit_noise, last.residual, base, last.unprojected, last.links,
    )  # fmt: skip


@dataclass(frozen=True)
class _Round:
    """What one round of the search came to."""

    state: SelectionState  # its noise and outliers by what was found
    fitted_samples: Mask  # (N,) samples that were fitted
    fit_noise: Noise
    space: SampleSpace
    near: SampleSpace  # the same, beside the links where their geometry is a cause
    unprojected: UnprojectedRows
    links: dict[int, Array]
    best: CandidateFit
    terms: tuple[Term, ...]
    index: tuple[int, ...]
    covariance: tuple[Array, ...]
    residual: Array

    def weakest(self, least: float) -> int | None:
        """Return the position of the term that is worth least, none of the links, if under a least.

        One of which the data show nothing at all is worth nothing: beside equal gains of all axes
        no load is sure.
        """
        share = {}
        for p, c in enumerate(self.index):
            if c not in self.links:
                size = self.space.candidates[c].scales
                sigma = np.sqrt(np.diag(self.covariance[p]))
                unknown = float((sigma / size[: len(sigma)]).min()) / UNDETERMINED_SPREAD
                share[p] = -unknown if unknown > 1 else worth(self.terms[p], self.covariance[p])
        weakest = min(share, key=lambda p: share[p], default=None)
        return None if weakest is None or share[weakest] >= least else weakest


def _round(
    state: SelectionState, model: Model, base: tuple[Term, ...], withheld: Iterable[str],
    none: set[tuple[str, Site]], offered: list[Pair], first: bool,
) -> _Round:  # fmt: skip
    """Search around the model with ``base``, refit what is found exactly, and look at the rest."""
    named = _named_candidates(state.observation, model, withheld, base)
    open_to = [c for c in named if (c.family, c.site) not in none]
    state = replace(state, candidates=open_to)
    columns = [exact_columns(state.observation, c, base) for c in open_to]
    if first:  # the rows after a late slip stand out unless it is among what may be there
        steps = step_candidates(state, columns, base, withheld)
        state = mark_outliers(state, [*zip(open_to, columns, strict=True), *steps])
    smooth = _without_known_loads(offered, open_to, columns, base)
    stepping = step_candidates(state, columns, base, withheld)
    state = replace(state, candidates=[*open_to, *(candidate for candidate, _ in stepping)])
    columns += [step_columns for _, step_columns in stepping]
    space, unprojected = sample_space(state, columns, base, smooth)
    inside = [candidate_of(state.candidates, t)[0] for t in base]
    best = one_delay(space, screened_search(space, base=inside))
    if not first and not state.kept.all():
        state, space, unprojected, best = readmit_explained_outliers(
            state, columns, base, smooth, (space, unprojected, best)
        )
    near, best, links = with_links(space, best, inside)
    fitted_samples, fit_noise = state.kept, state.noise
    exact = _refit_set(near, best, state)
    state, terms, index, covariance, residual = refit(state, space, exact, links)
    straight = with_straight_stiffness(space, best.chosen, index, terms, covariance)
    if straight is not None:
        best = pruned(near, fit(near, straight))
        state, terms, index, covariance, residual = refit(state, space, best, links)
    used = sum(len(v) for v in best.values) + (links_of(space, links).used if links else 0)
    noise_residual = _without_smooth_part(state, space, best, smooth, residual)
    state = revise_noise_and_outliers(state, noise_residual, 1 - used / space.freedom)
    return _Round(
        state, fitted_samples, fit_noise, space, near, unprojected, links, best, terms, index,
        covariance, residual,
    )  # fmt: skip


def _named_refit(last: _Round) -> _Round:
    """Return a round whose named terms are refitted alone, unnamed functions left in the set."""
    state = replace(last.state, kept=last.fitted_samples, noise=last.fit_noise)
    alone, best = _named_alone(last.near, last.best, last.state.observation)
    while True:
        state, terms, index, covariance, residual = refit(state, last.space, alone, last.links)
        last = replace(
            last, state=state, best=best, terms=terms, index=index, covariance=covariance,
            residual=residual,
        )  # fmt: skip
        weakest = last.weakest(NEGLIGIBLE_WORTH)
        if weakest is None:
            return last
        alone, best = (
            fit(last.near, [c for c in fitted.chosen if c != index[weakest]])
            for fitted in (alone, best)
        )


def _without_known_loads(
    smooth: list[Pair], candidates: Sequence[Candidate], columns: Sequence[Array],
    base: Sequence[Term],
) -> list[Pair]:  # fmt: skip
    """Return the smooth candidates, unnamed loads without what a load found does.

    A mass anywhere at the tool is a payload and its centre, a pull downwards a weight. Beside these
    it would show nothing of its own, but take their values away, and then stand where they do.
    """
    there = {t.effect for t in base}
    loads = [
        own.reshape(-1, own.shape[-1])
        for c, own in zip(candidates, columns, strict=True)
        if c.effect.carried and not c.site.joint and there & {c.family, c.beside}
    ]
    if not loads:
        return smooth
    U, remaining = basis_of(np.hstack(loads)), []
    for c, own in smooth:
        if c.without_quantity:
            X = basis_of(own.reshape(len(U), -1))
            _, share, V = np.linalg.svd(projected_out(U, X), full_matrices=False)
            unknown = share**2 > 1 - CONTAINED_SHARE
            if not unknown.any():
                continue
            if not unknown.all():
                rest = (X @ V[unknown].T).reshape(*own.shape[:2], -1)
                remaining.append(unnamed("", c.target, rest))
                continue
        remaining.append((c, own))
    return remaining


def _named_candidates(
    observation: Observation, model: Model, withheld: Iterable[str], base: tuple[Term, ...]
) -> list[Candidate]:
    """Return the named candidates that the observation can show, bounded, at a model's terms."""
    turns = [
        float(np.ptp(observation.quantities.get(joint_quantity(observation, i), np.zeros(1))))
        / (2 * np.pi)
        for i in range(model.arm.n)
    ]
    rotation = observation.measured.shape[1] > 3
    return [
        with_requirement(observation, _bounded(c, model, observation))
        for c in named_candidates(model.arm, observation.channel, withheld, rotation, base, turns)
        if _observable(c, observation)
    ]


def _named_alone(
    space: SampleSpace, best: CandidateFit, observation: Observation
) -> tuple[CandidateFit, CandidateFit]:
    """Return the named part of a set, as it stands without the unnamed functions, and with them.

    What goes into a model has to predict without the unnamed function beside it, nor may that
    stand where a named cause would without it: friction of the same joint. What an unknown moves
    one joint, of those that are measured one by one, says nothing of the causes at the others.
    """
    named = [c for c in best.chosen if space.candidates[c].named]
    near = space
    if observation.channel in ("tracking", "torque"):
        near = weighted_by_residual(space, named, observation.measured.shape[1])
    alone = pruned(near, forward_selected(near, fit(near, named), named_only=True)).chosen
    rest = (c for c in best.chosen if c not in named)
    return fit(space, alone), fit(space, (*alone, *rest))


def _refit_set(space: SampleSpace, best: CandidateFit, state: SelectionState) -> CandidateFit:
    """Return what of a set is refitted: of delays and lags the named alone.

    Beside them an unnamed function takes up what their curves lack at a first guess, and they would
    never come to where it is not needed.
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
    """Return the residual (N, k) less what the set's unnamed functions take of it.

    They are part of the explanation: what they account for is no noise. Not so in a large log of
    poses, where causes and a function of time share out the same: the causes stand alone there.
    """
    named = len(state.candidates)
    columns = [smooth[c - named][1] for c in best.chosen if c >= named]
    poses = state.observation.channel == "position" and len(space.y) >= LARGE_SAMPLE
    if not columns or poses:
        return residual
    both = np.concatenate([*columns, state.observation.nuisance], axis=2)
    rows, target = flat(both, state), flat(residual[..., None], state)[:, 0]
    return np.asarray(residual - both @ solve(rows, target))


def _bounded(candidate: Candidate, model: Model, observation: Observation) -> Candidate:
    """Return the candidate with bounds that keep the whole model physical (flexibility >= 0).

    Of a curve the bound holds for what its two parts come to together.
    """
    if candidate.effect.adds_mass:
        least, most = _payload_bounds(model, observation)
        mass = replace(candidate.parameters[0], lower=least, upper=most)
        return replace(candidate, parameters=(mass, *candidate.parameters[1:]))
    kind, curved = candidate.effect.flexibility, candidate.curve is not None
    if not (kind or curved):
        return candidate
    axial, radial = model.compliance()
    compliance = radial if kind == "radial" else axial
    assert candidate.site.joint is not None
    lower = -float(compliance[candidate.site.joint - 1])
    bounded = replace(candidate.parameters[0], lower=lower)
    return replace(candidate, parameters=(bounded, *candidate.parameters[1:]))


def _payload_bounds(model: Model, observation: Observation) -> tuple[float, float]:
    """Return how far a payload may be off: the true one is no less than nothing, and no giant."""
    declared = observation.quantities.get("payload", np.array([model.payload_mass]))
    most = MAX_PAYLOAD_FACTOR * max(float(declared.max()), LoadBounds.of(model).rated)
    return -float(declared.min()), most


def _observable(candidate: Candidate, observation: Observation) -> bool:
    if candidate.periodic:  # of a joint that moves at all
        assert candidate.site.joint is not None
        return joint_quantity(observation, candidate.site.joint - 1) in observation.quantities
    return all(
        any(q == need or q.startswith(f"{need}_") for q in observation.quantities)
        for need in candidate.effect.needs
        if need != "approach"  # without reversals play is an offset: a tie to be reported
    )


def terms_alike(a: tuple[Term, ...], b: tuple[Term, ...]) -> bool:
    """Return whether two sets of terms accuse the same effects at the same sites."""
    return {(t.effect, t.site) for t in a} == {(t.effect, t.site) for t in b}
