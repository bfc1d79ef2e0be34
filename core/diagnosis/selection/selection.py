"""Selection: from an observation to the terms that explain it.

Rounds of: columns at the model found so far, search, exact refit (Gauss-Newton on the whole
prediction, frames and all), outliers looked at again; until the set stays the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array, Mask
from gapbridge.core.diagnosis.criteria import (
    HEAVIEST,
    HELD_WHOLLY,
    LARGE_SAMPLE,
    OWN_SIGMAS,
    SIGMAS,
    UNDETERMINED,
)
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.selection.candidate import (
    Candidate,
    joint_quantity,
    named_candidates,
    with_what_it_needs,
)
from gapbridge.core.diagnosis.selection.delay_columns import exact_columns, one_delay
from gapbridge.core.diagnosis.selection.geometry import (
    Links,
    link_candidates,
    links_of,
    prior,
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
from gapbridge.core.diagnosis.selection.refit import Remainder, refit, worth
from gapbridge.core.diagnosis.selection.search import by_what_is_left, screened_search
from gapbridge.core.diagnosis.selection.smooth import Pair, smooth_candidates, unnamed
from gapbridge.core.diagnosis.selection.state import (
    SelectionState,
    UnprojectedRows,
    flat,
    locate,
    sample_space,
)
from gapbridge.core.diagnosis.selection.stiffness_curves import with_straight_stiffness
from gapbridge.core.effects import Site, Term
from gapbridge.core.estimation.least_squares import basis_of, projected_out, solve
from gapbridge.core.load_bounds import LoadBounds
from gapbridge.core.model import Model

ROUNDS = 8
NOTHING = 1e-4  # worth of a value: a thirtieth of its sigma


@dataclass(frozen=True)
class Selection:
    """What explains an observation, and the space in which it won."""

    observation: Observation  # frame as finally estimated
    space: SampleSpace  # columns at the final model; kept samples only
    found: CandidateFit  # without the links, where their geometry as a whole is a cause
    terms: tuple[Term, ...]  # the named part, refitted exactly
    term_index: tuple[int, ...]  # candidate index of each term
    covariance: tuple[Array, ...]  # per term (d, d) of its fitted parameters
    kept: NDArray[np.bool_]  # (N,) samples that are no outliers
    noise: Noise
    residual: Array  # (N, k) measured - predicted by the named terms, frame estimated along
    base: tuple[Term, ...]
    unprojected: UnprojectedRows  # the space before the nuisance was projected out
    prior: dict[int, Array] = field(default_factory=dict)  # 1 sigma (d,) of the numbers of each
    # link's candidate, where the geometry of all links is a cause
    held: dict[int, Mask] = field(default_factory=dict)  # numbers (d,) of these that stay nominal
    rows_each: float = 1.0  # rows of the log that each sample stands for, squares added up

    def unwhitener(self) -> Array:
        """Return what makes whitened kept samples (n, k, k) those of one row, channel unit."""
        whitener = self.noise.whitener[self.kept]
        return np.asarray(np.linalg.inv(whitener) / np.sqrt(self.rows_each))

    @property
    def nuisance_basis(self) -> Array:
        """Return an orthonormal basis (m, p) of the nuisance in the sample space."""
        return self.unprojected.basis

    @property
    def block(self) -> tuple[int, ...]:
        """Return the candidates of all links, where their geometry is a cause as a whole."""
        return tuple(self.prior)

    def judged_together(self, positions: Sequence[int]) -> list[tuple[int, ...]]:
        """Return positions of terms in the groups of which one term has to be sure by itself.

        The links' geometry is accused as a whole, the joints' zeros in it: without these a UR10's
        links stand for them. Everything else goes by joints: these zeros once more, first moments
        and friction too.
        """
        whole = tuple(p for p in positions if self._in_geometry(p))
        single = [(p,) for p in positions if not self.is_link(p)]
        return [*single, whole] if whole else list(single)

    def is_link(self, position: int) -> bool:
        """Return whether a term is of the links' geometry, where that is a cause as a whole."""
        together = self.space.candidates[self.term_index[position]].effect.together
        return self._in_geometry(position) and together

    def _in_geometry(self, position: int) -> bool:
        return self.observation.channel == "position" and self.term_index[position] in self.prior

    @cached_property
    def links(self) -> Links | None:
        """Return the links' geometry as a whole, where it is a cause."""
        return links_of(self.space, self.prior) if self.prior else None

    @cached_property
    def working(self) -> SampleSpace:
        """Return the space in which ``found`` won: beside the links, where they are a cause."""
        return self.space if self.links is None else self.links.beside(self.space, self.block)

    def rows_of(self, columns: Array) -> Array:
        """Return columns (N, k, d) as rows (m, d) of the working space."""
        rows = self.plain_rows_of(columns)
        return rows if self.links is None else self.links.whitened(rows)

    def plain_rows_of(self, columns: Array) -> Array:
        """Return columns (N, k, d) as rows (m, d) of the space in which the links are no noise."""
        kept, B = self.kept, self.nuisance_basis
        rows = (self.noise.whitener[kept] @ columns[kept]).reshape(len(B), -1)
        return projected_out(B, rows)

    def pull(self, chosen: Sequence[int]) -> Array:
        """Return one over the prior sigma of each number of a set of candidates; 0: none."""
        size = np.diff(self.space.start)
        each = [1 / self.prior[c] if c in self.prior else np.zeros(int(size[c])) for c in chosen]
        return np.concatenate([*each, np.zeros(0)])

    def fitted(self, chosen: Sequence[int]) -> dict[int, Array]:
        """Return the linear values (d,) of a set of candidates; links are kept near nominal."""
        space, size = self.space, np.diff(self.space.start)
        X = space.columns(chosen)
        x = solve(X, space.y, self.pull(chosen))
        return dict(zip(chosen, np.split(x, np.cumsum(size[list(chosen)])[:-1]), strict=True))

    def sized_beside(self, chosen: Sequence[int]) -> Selection:
        """Return the selection with the links of the size that is most likely beside a set.

        What falls leaves them more to account for, or nothing to be large for.
        """
        if not self.prior:
            return self
        rest = [c for c in chosen if c not in self.block]
        sigma = prior(self.space, self.block, rest, self.held)
        if all(np.array_equal(sigma[c], own) for c, own in self.prior.items()):
            return self
        return replace(self, prior=sigma)

    def far_off(self, positions: Sequence[int]) -> dict[int, Mask]:
        """Return, by candidate, numbers of the links (d,) that neither prior nor data vouch for.

        Where all others are of one size, a number several times as large is no machining: it
        stands by itself, and has to be as sure as what is accused by itself.
        """
        found = {}
        for p in positions:
            c = self.term_index[p]
            if c in self.prior and self.observation.channel == "position":
                size = np.abs(self.terms[p].values)
                unsure = size < SIGMAS * np.sqrt(np.diag(self.covariance[p]))
                far = (size > OWN_SIGMAS * self.prior[c]) & unsure
                if far.any():
                    found[c] = far
        return found

    def with_nominal(self, numbers: Mapping[int, Mask]) -> Selection:
        """Return the selection with further numbers of the links (d,) held nominal."""
        return replace(self, held=self.held | {
            c: own | self.held.get(c, False) for c, own in numbers.items()
        })  # fmt: skip

    def without_links(self) -> Selection:
        """Return the selection with the links' geometry no cause, the rest as it is."""
        index = [p for p, c in enumerate(self.term_index) if c not in self.block]
        return replace(
            self, prior={}, found=fit(self.space, self.found.chosen),
            terms=tuple(self.terms[p] for p in index),
            term_index=tuple(self.term_index[p] for p in index),
            covariance=tuple(self.covariance[p] for p in index),
        )  # fmt: skip

    def with_all_links(self, arm: Arm) -> Selection | None:
        """Return the selection with the links' geometry as a whole in the place of single links.

        What else was found stays as far as it pays beside them; None where the arm has no links.
        """
        space, block = self.space, link_candidates(self.space)
        if len(block) < 2:
            return None
        chosen = [c for c in self.found.chosen if c not in block]
        sigma = prior(space, block, chosen)
        near = links_of(space, sigma).beside(space, block)
        found = pruned(near, fit(near, chosen))
        state = SelectionState(self.observation, arm, [], self.noise, self.kept)
        state, terms, index, covariance, residual = refit(state, space, found, sigma)
        return replace(
            self, observation=state.observation, prior=sigma, found=found, terms=terms,
            term_index=index, covariance=covariance, residual=residual,
        )  # fmt: skip

    @property
    def used(self) -> float:
        """Return the number of fitted unknowns, nuisance included; of the links what they use."""
        links = 0.0 if self.links is None else self.links.used
        return (
            float(self.unprojected.nuisance.shape[1] + sum(len(v) for v in self.found.values))
            + links
        )

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
    base: tuple[Term, ...] = ()
    kept = np.ones(len(observation.rows), dtype=bool)
    first = estimate_noise(observation, observation.measured - observation.predict(()), kept)
    state = SelectionState(observation, model.arm, [], first, kept)
    found: CandidateFit | None = None
    space: SampleSpace | None = None
    near: SampleSpace | None = None  # the same, beside the links where their geometry is a cause
    columns: list[Array] = []
    offered = smooth_candidates(observation)
    none: set[tuple[str, Site]] = set()  # what the exact refit takes back: its place is free
    for turn in range(ROUNDS):
        if progress:
            progress(f"{observation.channel}: round {turn + 1}")
        named = _named_candidates(observation, model, withheld, base)
        open_to = [c for c in named if (c.family, c.site) not in none]
        state = replace(state, candidates=open_to)
        # the last round's are as large as the new ones: not both at a time
        space, near, columns = None, None, []
        columns = [exact_columns(state.observation, c, base) for c in open_to]
        if turn == 0:  # the rows after a late slip stand out unless it is among what may be there
            steps = step_candidates(state, columns, base, withheld)
            state = mark_outliers(state, [*zip(open_to, columns, strict=True), *steps])
        smooth = _beyond_loads(offered, open_to, columns, base)
        stepping = step_candidates(state, columns, base, withheld)
        state = replace(state, candidates=[*open_to, *(candidate for candidate, _ in stepping)])
        columns += [own for _, own in stepping]
        space, unprojected = sample_space(state, columns, base, smooth)
        inside = [locate(state.candidates, t)[0] for t in base]
        best = one_delay(space, screened_search(space, base=inside))
        if turn > 0 and not state.kept.all():
            state, space, unprojected, best = readmit_explained_outliers(
                state, columns, base, smooth, (space, unprojected, best)
            )
        near, best, links = with_links(space, best, inside)
        counted, whitened_by = state.kept, state.noise
        exact = _exactly(near, best, state)
        state, terms, index, covariance, residual = refit(state, space, exact, links)
        straight = with_straight_stiffness(space, best.chosen, index, terms, covariance)
        if straight is not None:
            best = pruned(near, fit(near, straight))
            state, terms, index, covariance, residual = refit(state, space, best, links)
        same = terms_alike(terms, base) and turn > 0
        found = best
        used = sum(len(v) for v in best.values) + (links_of(space, links).used if links else 0)
        free = 1 - used / space.freedom
        left = _without_smooth_part(state, space, best, smooth, residual)
        state = revise_noise_and_outliers(state, left, free)
        settled = same and bool((state.kept == counted).all())
        # beside an unnamed function a value is not yet what it comes to without; but what shows
        # nothing by itself (the scale of a torque that is not there) keeps the place of what does
        named_only = all(space.candidates[c].named for c in best.chosen)
        least = 1.0 if settled and named_only else NOTHING
        weakest = _weakest(space, terms, index, covariance, links, least)
        base = terms
        if weakest is not None:
            none.add((terms[weakest].effect, terms[weakest].site))
            base = terms[:weakest] + terms[weakest + 1 :]
        elif settled:
            break
    assert space is not None and near is not None and found is not None
    if len(space.y) >= LARGE_SAMPLE and any(not space.candidates[c].named for c in found.chosen):
        state = replace(state, kept=counted, noise=whitened_by)
        alone, found = _named_alone(near, found, observation)
        state, terms, index, covariance, residual = refit(state, space, alone, links)
        while (weakest := _weakest(space, terms, index, covariance, links, NOTHING)) is not None:
            alone, found = (
                fit(near, [c for c in own.chosen if c != index[weakest]]) for own in (alone, found)
            )
            state, terms, index, covariance, residual = refit(state, space, alone, links)
    return Selection(
        state.observation, space, found, terms, index, covariance, counted, whitened_by,
        residual, base, unprojected, links,
    )  # fmt: skip


def _beyond_loads(
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
    U, found = basis_of(np.hstack(loads)), []
    for c, own in smooth:
        if c.of_no_quantity:
            X = basis_of(own.reshape(len(U), -1))
            _, left, V = np.linalg.svd(projected_out(U, X), full_matrices=False)
            unknown = left**2 > 1 - HELD_WHOLLY
            if not unknown.any():
                continue
            if not unknown.all():
                rest = (X @ V[unknown].T).reshape(*own.shape[:2], -1)
                found.append(unnamed("", c.target, rest))
                continue
        found.append((c, own))
    return found


def _weakest(
    space: SampleSpace, terms: Sequence[Term], index: Sequence[int], covariance: Sequence[Array],
    links: Iterable[int], least: float,
) -> int | None:  # fmt: skip
    """Return the position of the term that is worth least, none of the links, if under a least.

    One of which the data show nothing at all is worth nothing: beside equal gains of all axes no
    load is sure.
    """
    share = {}
    for p, c in enumerate(index):
        if c not in set(links):
            size = np.array([k.scale for k in space.candidates[c].parameters])
            spread = np.sqrt(np.diag(covariance[p])) / size[: len(covariance[p])]
            unknown = float(spread.min()) / UNDETERMINED
            share[p] = -unknown if unknown > 1 else worth(terms[p], covariance[p])
    weakest = min(share, key=lambda p: share[p], default=None)
    return None if weakest is None or share[weakest] >= least else weakest


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
        with_what_it_needs(observation, _bounded(c, model, observation))
        for c in named_candidates(model.arm, observation.channel, withheld, rotation, base, turns)
        if _has_what_it_needs(c, observation)
    ]


def _named_alone(
    space: SampleSpace, found: CandidateFit, observation: Observation
) -> tuple[CandidateFit, CandidateFit]:
    """Return the named part of a set, as it stands without the unnamed functions, and with them.

    What goes into a model has to predict without the unnamed function beside it, nor may that
    stand where a named cause would without it: friction of the same joint. What an unknown moves
    one joint, of those that are measured one by one, says nothing of the causes at the others.
    """
    named = [c for c in found.chosen if space.candidates[c].named]
    near = space
    if observation.channel in ("tracking", "torque"):
        near = by_what_is_left(space, named, observation.measured.shape[1])
    alone = pruned(near, forward_selected(near, fit(near, named), named_only=True)).chosen
    rest = (c for c in found.chosen if c not in named)
    return fit(space, alone), fit(space, (*alone, *rest))


def _exactly(space: SampleSpace, best: CandidateFit, state: SelectionState) -> CandidateFit:
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


def refitted_alone(
    selection: Selection, arm: Arm, accused: Sequence[int], remainder: Remainder | None = None
) -> Selection:
    """Return the selection with some of its terms (positions) refitted as all there is.

    Values that were fitted beside a withdrawn term are not those that stand without it. The
    ``remainder`` accounts for what is left: in a short log it would bias the values; a long one
    averages over it, and its model has to predict without it. Beside all links it would take what
    their prior holds back.
    """
    whole = len(accused) == len(selection.terms) and remainder is None
    if not accused or (whole and not selection.held):
        return selection
    chosen = [selection.term_index[p] for p in accused]
    selection = selection.sized_beside(chosen)
    links = {c: sigma for c, sigma in selection.prior.items() if c in chosen}
    if remainder is not None and (links or len(selection.space.y) >= LARGE_SAMPLE):
        remainder = remainder.scatter_alone()
    state = SelectionState(selection.observation, arm, [], selection.noise, selection.kept)
    space = selection.working if links else selection.space
    alone = fit(space, [c for c in chosen if c not in links])
    state, fitted, index, spread, residual = refit(state, selection.space, alone, links, remainder)
    terms, covariance = list(selection.terms), list(selection.covariance)
    for c, term, own in zip(index, fitted, spread, strict=True):
        position = selection.term_index.index(c)
        if (nominal := selection.held.get(c)) is not None:
            term = term.with_values(np.where(nominal, 0.0, term.values))
            own = own * ~(nominal | nominal[:, None])
        terms[position], covariance[position] = term, own
    return replace(
        selection, observation=state.observation, terms=tuple(terms),
        covariance=tuple(covariance), residual=residual,
    )  # fmt: skip


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
    own = radial if kind == "radial" else axial
    assert candidate.site.joint is not None
    lower = -float(own[candidate.site.joint - 1])
    bounded = replace(candidate.parameters[0], lower=lower)
    return replace(candidate, parameters=(bounded, *candidate.parameters[1:]))


def _payload_bounds(model: Model, observation: Observation) -> tuple[float, float]:
    """Return how far a payload may be off: the true one is no less than nothing, and no giant."""
    declared = observation.quantities.get("payload", np.array([model.payload_mass]))
    most = HEAVIEST * max(float(declared.max()), LoadBounds.of(model).rated)
    return -float(declared.min()), most


def _has_what_it_needs(candidate: Candidate, observation: Observation) -> bool:
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
