"""Selection: from an observation to the terms that explain it.

Rounds of: columns at the model found so far, search, exact refit (Gauss-Newton on the whole
prediction, frames and all), wild readings looked at again; until the set stays the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.arm import Arm
from core.diagnosis.observation import Observation
from core.diagnosis.selection.bent import straightened
from core.diagnosis.selection.candidate import (
    Candidate,
    joint_quantity,
    named_candidates,
)
from core.diagnosis.selection.following import exact_columns
from core.diagnosis.selection.local_search import pruned
from core.diagnosis.selection.moments import step_candidates
from core.diagnosis.selection.noise import Noise, estimate_noise
from core.diagnosis.selection.outliers import look_again, look_for_wild, with_wild_explained
from core.diagnosis.selection.problem import Found, Space, fit
from core.diagnosis.selection.refit import refit
from core.diagnosis.selection.search import LARGE, screened_search
from core.diagnosis.selection.smooth import smooth_candidates
from core.diagnosis.selection.state import Raw, Work, flat, locate, sample_space
from core.effects import Term
from core.errors import InputError
from core.model import Model

Array = NDArray[np.float64]
ROUNDS = 5
FORBIDDEN = 1e9  # a price that no fit is worth


@dataclass(frozen=True)
class Selection:
    """What explains an observation, and the space in which it won."""

    observation: Observation  # frame as finally estimated
    space: Space  # columns at the final model; kept samples only
    found: Found
    terms: tuple[Term, ...]  # the named part, refitted exactly
    term_index: tuple[int, ...]  # candidate index of each term
    covariance: tuple[Array, ...]  # per term (d, d) of its fitted parameters
    kept: NDArray[np.bool_]  # (N,) samples that are not wild
    noise: Noise
    residual: Array  # (N, k) measured - predicted by the named terms, frame estimated along
    base: tuple[Term, ...]
    raw: Raw  # the space before the nuisance was projected out

    @property
    def nuisance_basis(self) -> Array:
        """Return an orthonormal basis (m, p) of the nuisance in the sample space."""
        return self.raw.basis

    @property
    def used(self) -> float:
        """Return the number of fitted unknowns, nuisance included."""
        return float(self.raw.nuisance.shape[1] + sum(len(v) for v in self.found.values))

    @property
    def groups(self) -> NDArray[np.int64]:
        """Return the condition of every row of the sample space (m,)."""
        k = self.observation.measured.shape[1]
        return np.repeat(self.observation.groups[self.kept], k)


def select(
    observation: Observation,
    model: Model,
    withheld: Iterable[str] = (),
    progress: Callable[[str], None] | None = None,
) -> Selection:
    """Return the best explanation of an observation by named effects and smooth functions."""
    arm = model.arm
    rotation = observation.measured.shape[1] > 3
    base: tuple[Term, ...] = ()
    turns = [
        float(np.ptp(observation.quantities.get(joint_quantity(observation, i), np.zeros(1))))
        / (2 * np.pi)
        for i in range(arm.n)
    ]
    kept = np.ones(len(observation.rows), dtype=bool)
    first = estimate_noise(observation, observation.measured - observation.predict(()), kept)
    work = Work(observation, arm, [], first, kept)
    found: Found | None = None
    space: Space | None = None
    columns: list[Array] = []
    smooth = smooth_candidates(observation, arm)
    for turn in range(ROUNDS):
        if progress:
            progress(f"{observation.channel}: round {turn + 1}")
        work.candidates = [
            _bounded(c, model)
            for c in named_candidates(arm, observation.channel, withheld, rotation, base, turns)
            if _has_what_it_needs(c, observation)
        ]
        space, columns = None, []  # the last round's, as large as the new ones: not both at a time
        columns = [exact_columns(work.observation, c, base) for c in work.candidates]
        if turn == 0:
            look_for_wild(work, columns)
        stepping = step_candidates(work, columns, base, withheld)
        work.candidates += [candidate for candidate, _ in stepping]
        columns += [own for _, own in stepping]
        space, raw = sample_space(work, columns, base, smooth)
        inside = [locate(work.candidates, t)[0] for t in base]
        best = screened_search(space, base=inside)
        if turn > 0 and not work.kept.all():
            space, raw, best = with_wild_explained(work, columns, base, smooth, (space, raw, best))
        counted, whitened_by = work.kept.copy(), work.noise
        framed = work.observation
        try:
            terms, index, covariance, residual = refit(work, space, _exactly(space, best, work))
        except InputError:  # absurd flexibilities: the arm would buckle
            work.observation = framed  # not the frame that went astray with them
            best = _stiff(space, best, inside)
            terms, index, covariance, residual = refit(work, space, best)
        straight = straightened(space, best.chosen, index, terms, covariance)
        if straight is not None:
            best = pruned(space, fit(space, straight))
            terms, index, covariance, residual = refit(work, space, best)
        same = terms_alike(terms, base) and turn > 0
        found = best
        free = 1 - sum(len(v) for v in best.values) / space.freedom
        changed = look_again(work, _less_smooth(work, space, best, smooth, residual), free)
        if same and not changed:
            break
        base = terms
    assert space is not None and found is not None
    if len(space.y) >= LARGE and any(not space.candidates[c].named for c in found.chosen):
        work.kept, work.noise = counted.copy(), whitened_by
        # what goes into a model has to predict without the unnamed function beside it
        alone = fit(space, [c for c in found.chosen if space.candidates[c].named])
        terms, index, covariance, residual = refit(work, space, alone)
    return Selection(
        work.observation, space, found, terms, index, covariance, counted, whitened_by,
        residual, base, raw,
    )  # fmt: skip


def _stiff(space: Space, best: Found, inside: list[int]) -> Found:
    """Return the best set without anything that gives way: what was found makes no arm."""
    gives_way = np.array([c.gives_way for c in space.candidates])
    stiff = replace(space, price=np.where(gives_way, FORBIDDEN, space.price))
    start = {*inside, *best.chosen} - {int(c) for c in np.flatnonzero(gives_way)}
    return screened_search(stiff, base=sorted(start))


def _exactly(space: Space, best: Found, work: Work) -> Found:
    """Return what of a set is refitted: of delays and lags the named alone.

    Beside them an unnamed function takes up what their curves lack at a first guess, and they would
    never come to where it is not needed.
    """
    if work.observation.channel != "tracking":
        return best
    return fit(space, [c for c in best.chosen if space.candidates[c].named])


def _less_smooth(
    work: Work, space: Space, best: Found, smooth: list[tuple[Candidate, Array]], residual: Array
) -> Array:
    """Return the residual (N, k) less what the set's unnamed functions take of it.

    They are part of the explanation: what they account for is no noise. Not so in a large log of
    poses, where causes and a function of time share out the same: the causes stand alone there.
    """
    named = len(work.candidates)
    columns = [smooth[c - named][1] for c in best.chosen if c >= named]
    poses = work.observation.channel == "position" and len(space.y) >= LARGE
    if not columns or poses:
        return residual
    both = np.concatenate([*columns, work.observation.nuisance], axis=2)
    rows, target = flat(both, work), flat(residual[..., None], work)[:, 0]
    return np.asarray(residual - both @ np.linalg.lstsq(rows, target, rcond=1e-9)[0])


def standing(selection: Selection, arm: Arm, accused: Sequence[int]) -> Selection:
    """Return the selection with some of its terms (positions) refitted as all there is.

    Values that were fitted beside a withdrawn term are not those that stand without it.
    """
    if not accused or len(accused) == len(selection.terms):
        return selection
    work = Work(selection.observation, arm, [], selection.noise, selection.kept)
    chosen = [selection.term_index[p] for p in accused]
    fitted, index, spread, residual = refit(work, selection.space, fit(selection.space, chosen))
    terms, covariance = list(selection.terms), list(selection.covariance)
    for c, term, own in zip(index, fitted, spread, strict=True):
        position = selection.term_index.index(c)
        terms[position], covariance[position] = term, own
    return replace(
        selection, observation=work.observation, terms=tuple(terms),
        covariance=tuple(covariance), residual=residual,
    )  # fmt: skip


def _bounded(candidate: Candidate, model: Model) -> Candidate:
    """Return the candidate with bounds that keep the whole model physical (flexibility >= 0).

    Of a curve the bound holds for what its two parts come to together.
    """
    kind, curved = candidate.effect.flexibility, candidate.curve is not None
    if not (kind or curved):
        return candidate
    axial, radial = model.compliance()
    own = radial if kind == "radial" else axial
    assert candidate.site.joint is not None
    lower = -float(own[candidate.site.joint - 1])
    bounded = replace(candidate.parameters[0], lower=lower)
    return replace(candidate, parameters=(bounded, *candidate.parameters[1:]))


def _has_what_it_needs(candidate: Candidate, observation: Observation) -> bool:
    if candidate.periodic:  # of a joint that moves at all
        assert candidate.site.joint is not None
        return joint_quantity(observation, candidate.site.joint - 1) in observation.quantities
    return all(
        any(q == need or q.startswith(f"{need}_") for q in observation.quantities)
        for need in candidate.effect.needs
        if need != "approach"  # without reversals play is an offset: a tie to be told
    )


def terms_alike(a: tuple[Term, ...], b: tuple[Term, ...]) -> bool:
    """Return whether two sets of terms accuse the same effects at the same sites."""
    return {(t.effect, t.site) for t in a} == {(t.effect, t.site) for t in b}
