"""The result of a search in an observation: terms with covariances, noise and residual."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array, Mask
from gapbridge.core.diagnosis.criteria import (
    CURVATURE_GAIN,
    LARGE_SAMPLE,
    MAX_EXCESS_WITH_UNNAMED,
    MIN_SIGMAS,
    MIN_SIGMAS_WITH_UNNAMED,
    NEGLIGIBLE_WORTH,
    PRIOR_REACH,
    UNDETERMINED_SPREAD,
)
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.selection.geometry import (
    NOMINAL,
    Links,
    link_candidates,
    links_of,
    machining_tolerance,
    prior,
)
from gapbridge.core.diagnosis.selection.local_search import pruned
from gapbridge.core.diagnosis.selection.noise import Noise
from gapbridge.core.diagnosis.selection.refit import UnnamedPart, refit, worth
from gapbridge.core.diagnosis.selection.sample_space import CandidateFit, SampleSpace, fit
from gapbridge.core.diagnosis.selection.state import SelectionState, UnprojectedRows, flat
from gapbridge.core.effects import CATALOGUE, Term
from gapbridge.core.estimation.least_squares import projected_out, solve


@dataclass(frozen=True)
class Selection:
    """The terms that explain an observation, and the space in which they were selected."""

    observation: Observation  # with the final estimate of the frame
    space: SampleSpace  # columns at the final model; kept samples only
    best: CandidateFit  # without the links, where their geometry as a whole is a cause
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
    nominal: dict[int, Mask] = field(default_factory=dict)  # their parameters (d,) kept nominal
    rows_each: float = 1.0  # rows of the log that each sample represents (their squares added)
    # of sums of products: the same candidates on rows of the log
    excerpt: Selection | None = None

    def unwhitener(self) -> Array:
        """Return the matrices (n, k, k) from whitened kept samples to one row in channel units."""
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

    def judged_alone(self, positions: Sequence[int]) -> list[int]:
        """Return the positions of terms that have to be significant.

        Not those of the links' geometry as a whole, which is judged by its gain in regions that
        were not fitted; unless nothing of it is left. (Of positions in another order all numbers
        were held nominal, and a cause of zeros remained.)
        """
        links = [p for p in positions if self.is_link(p)]
        if any(worth(self.terms[p], self.covariance[p]) > NEGLIGIBLE_WORTH for p in links):
            return [p for p in positions if p not in links]
        return list(positions)

    def is_link(self, position: int) -> bool:
        """Return whether a term is a link's geometry, where all links are a cause."""
        together = self.space.candidates[self.term_index[position]].effect.estimated_as_whole
        return self._in_geometry(position) and together

    def _in_geometry(self, position: int) -> bool:
        return self.observation.channel == "position" and self.term_index[position] in self.prior

    @cached_property
    def links(self) -> Links | None:
        """Return the links' geometry where it is a cause as a whole."""
        return links_of(self.space, self.prior) if self.prior else None

    @cached_property
    def working(self) -> SampleSpace:
        """Return the space in which ``best`` was found: whitened by links that are a cause."""
        links = self.links
        return self.space if links is None else links.whitened_space(self.space, self.block)

    def rows_of(self, columns: Array) -> Array:
        """Return columns (N, k, d) as rows (m, d) of the working space."""
        rows = self.plain_rows_of(columns)
        return rows if self.links is None else self.links.whitened(rows)

    def plain_rows_of(self, columns: Array) -> Array:
        """Return columns (N, k, d) as rows (m, d) of the space not whitened by the links."""
        kept, B = self.kept, self.nuisance_basis
        rows = (self.noise.whitener[kept] @ columns[kept]).reshape(len(B), -1)
        return projected_out(B, rows)

    def pull(self, chosen: Sequence[int]) -> Array:
        """Return one over the prior sigma of each parameter of a set of candidates; 0: none."""
        size = np.diff(self.space.start)
        each = [1 / self.prior[c] if c in self.prior else np.zeros(int(size[c])) for c in chosen]
        return np.concatenate([*each, np.zeros(0)])

    def fitted(self, chosen: Sequence[int]) -> dict[int, Array]:
        """Return the linear values (d,) of a set of candidates, links with their prior."""
        space, size = self.space, np.diff(self.space.start)
        X = space.columns(chosen)
        x = solve(X, space.y, self.pull(chosen))
        return dict(zip(chosen, np.split(x, np.cumsum(size[list(chosen)])[:-1]), strict=True))

    def with_prior_for(self, chosen: Sequence[int]) -> Selection:
        """Return the selection with the links' prior re-estimated for a set of other terms."""
        if not self.prior:
            return self
        others = [c for c in chosen if c not in self.block]
        sigma = prior(self.space, self.block, others, self.nominal)
        if all(np.array_equal(sigma[c], own) for c, own in self.prior.items()):
            return self
        return replace(self, prior=sigma)

    def implausible_parameters(self, positions: Sequence[int]) -> dict[int, Mask]:
        """Return, by candidate, parameters (d,) of positions that are not significant, but large.

        A link's value several times the machining tolerance of all others has to be as significant
        as a single cause. Of single links it is the farthest one only, since others may depend on
        it. Of other effects it is what is not identifiable: it may be anything. (A tool of a UR10
        stood 20 mm off along its axis, with a standard deviation of 47 mm.) A stiffness curve is
        none without its curvature, of which the likelihood decides.
        """
        implausible: dict[int, Mask] = {}
        single: dict[int, tuple[Mask, float]] = {}
        for p in positions:
            c = self.term_index[p]
            usual = _usual_size(self, c)
            spread = np.sqrt(np.diag(self.covariance[p]))
            size = np.abs(self.terms[p].values[: len(spread)])  # others are fixed
            unsure = size < MIN_SIGMAS_WITH_UNNAMED * spread
            if usual is None:
                # alone, what is not significant is no cause
                several = len(unsure) > 1 and not self.space.candidates[c].effect.has_nonlinearity
                if self.observation.channel == "position" and several and unsure.any():
                    unsure &= spread > UNDETERMINED_SPREAD * self.space.candidates[c].scales
                    implausible |= {c: unsure} if unsure.any() else {}
                continue
            times = size / usual
            far = (times > MIN_SIGMAS) & unsure
            if far.any() and c in self.prior:
                implausible[c] = far
            elif far.any():
                farthest = np.where(far, times, 0.0)
                single[c] = farthest == farthest.max(), float(farthest.max())
        if single:
            c = max(single, key=lambda c: single[c][1])
            implausible[c] = single[c][0]
        return implausible

    def with_nominal(self, numbers: Mapping[int, Mask]) -> Selection:
        """Return the selection with further parameters (d,) kept nominal."""
        return replace(self, nominal=self.nominal | {
            c: own | self.nominal.get(c, False) for c, own in numbers.items()
        })  # fmt: skip

    def linear_curves(self, positions: Iterable[int]) -> dict[int, int | None]:
        """Return stiffness curves that are linear, with the candidate of the axial compliance.

        By the standard deviation of the curvature, over the regions of the log, for which there is
        no likelihood. None: axial compliance is no candidate.
        """
        linear: dict[int, int | None] = {}
        for p in positions:
            term, effect = self.terms[p], CATALOGUE[self.terms[p].effect]
            if not effect.has_nonlinearity:
                continue
            if term.values[1] ** 2 < CURVATURE_GAIN * self.covariance[p][1, 1]:
                linear[p] = next((
                    c for c, k in enumerate(self.space.candidates)
                    if k.family == effect.replaces and k.site.joint == term.site.joint
                ), None)  # fmt: skip
        return linear

    def with_lines(self, lines: Mapping[int, int]) -> Selection:
        """Return the selection with axial compliances (candidates) for curves (positions)."""
        terms, index, covariance = list(self.terms), list(self.term_index), list(self.covariance)
        for p, line in lines.items():
            terms[p] = self.space.candidates[line].term(np.array(terms[p].values[:1]))
            index[p], covariance[p] = line, covariance[p][:1, :1]
        instead = dict(zip(self.term_index, index, strict=True))
        best = fit(self.working, [instead.get(c, c) for c in self.best.chosen])
        return replace(
            self, terms=tuple(terms), term_index=tuple(index), covariance=tuple(covariance),
            best=best,
        )  # fmt: skip

    def without_links(self) -> Selection:
        """Return the selection without the links' geometry as a cause."""
        index = [p for p, c in enumerate(self.term_index) if c not in self.block]
        return replace(
            self, prior={}, best=fit(self.space, self.best.chosen),
            terms=tuple(self.terms[p] for p in index),
            term_index=tuple(self.term_index[p] for p in index),
            covariance=tuple(self.covariance[p] for p in index),
        )  # fmt: skip

    def with_all_links(self, arm: Arm) -> Selection | None:
        """Return the selection with all links as a cause instead of single links.

        Other terms are kept if they still improve the score. None if the arm has no such links.
        """
        space, block = self.space, link_candidates(self.space)
        if len(block) < 2:
            return None
        chosen = [c for c in self.best.chosen if c not in block]
        sigma = prior(space, block, chosen)
        near = links_of(space, sigma).whitened_space(space, block)
        best = pruned(near, fit(near, chosen))
        state = SelectionState(self.observation, arm, [], self.noise, self.kept)
        state, terms, index, covariance, residual = refit(state, space, best, sigma)
        return replace(
            self, observation=state.observation, prior=sigma, best=best, terms=terms,
            term_index=index, covariance=covariance, residual=residual,
        )  # fmt: skip

    @property
    def used(self) -> float:
        """Return the number of fitted parameters, nuisance included, effective ones of links."""
        links = 0.0 if self.links is None else self.links.used
        linear = self.unprojected.nuisance.shape[1] + sum(len(v) for v in self.best.values)
        return float(linear) + links

    @property
    def groups(self) -> NDArray[np.int64]:
        """Return the condition of every row of the sample space (m,)."""
        k = self.observation.measured.shape[1]
        return np.repeat(self.observation.groups[self.kept], k)


def _usual_size(selection: Selection, c: int) -> Array | None:
    """Return the usual 1 sigma (d,) of a link's parameters; None: no link's geometry."""
    if selection.observation.channel != "position":
        return None
    if c in selection.prior:
        return selection.prior[c]
    link = selection.space.candidates[c]
    return machining_tolerance(link) if link.effect.estimated_as_whole else None


def refitted_alone(
    selection: Selection, arm: Arm, accused: Sequence[int], unnamed_part: UnnamedPart | None = None,
    start: Sequence[Term] | None = None,
) -> Selection:  # fmt: skip
    """Return the selection with the ``accused`` terms (positions) refitted without the others.

    It begins from the terms ``start``, by default the selection's. In a short log the
    ``unnamed_part`` is fitted too, because the residual structure would bias the values. A long log
    averages over it, and the functions would absorb the links' part. Nor are the functions used
    where they absorb a direction of the terms, whose values then leave more by themselves.
    """
    whole = len(accused) == len(selection.terms) and unnamed_part is None
    if not accused or (whole and not selection.nominal):
        return selection
    chosen = [selection.term_index[p] for p in accused]
    selection = selection.with_prior_for(chosen)
    links = {c: sigma for c, sigma in selection.prior.items() if c in chosen}
    links |= {
        c: np.where(fixed, NOMINAL, PRIOR_REACH) * selection.space.candidates[c].scales
        for c, fixed in selection.nominal.items() if c in chosen and c not in links
    }  # fmt: skip
    if unnamed_part is not None and (links or len(selection.space.y) >= LARGE_SAMPLE):
        unnamed_part = unnamed_part.scatter_alone()
    state = SelectionState(selection.observation, arm, [], selection.noise, selection.kept)
    space = selection.working if selection.prior and links else selection.space
    alone = fit(space, [c for c in chosen if c not in links])
    terms = selection.terms if start is None else start
    begin = {c: terms[p] for p, c in zip(accused, chosen, strict=True)}
    result = refit(state, selection.space, alone, links, unnamed_part, begin)
    if unnamed_part is not None and unnamed_part.columns.shape[1]:
        plain = refit(state, selection.space, alone, links, unnamed_part.scatter_alone(), begin)
        left, least = (float(np.sum(flat(r[-1][..., None], state) ** 2)) for r in (result, plain))
        if left > MAX_EXCESS_WITH_UNNAMED**2 * least:
            result = plain
    state, fitted, index, spread, residual = result
    terms, covariance = list(selection.terms), list(selection.covariance)
    for c, term, term_covariance in zip(index, fitted, spread, strict=True):
        position = selection.term_index.index(c)
        if (fixed := selection.nominal.get(c)) is not None:
            values = np.array(term.values)
            values[: len(fixed)][fixed] = 0.0
            term = term.with_values(values)
            term_covariance = term_covariance * ~(fixed | fixed[:, None])
        terms[position], covariance[position] = term, term_covariance
    return replace(
        selection, observation=state.observation, terms=tuple(terms),
        covariance=tuple(covariance), residual=residual,
    )  # fmt: skip
