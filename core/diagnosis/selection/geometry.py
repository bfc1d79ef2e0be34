"""All links as one cause: many small parameters, none of which is significant alone.

In positions the geometry of the links; in torques their first moments, of which only combinations
are identifiable (base parameters; Gautier, Khalil, IEEE Trans. Robotics and Automation 6 (1990)
368), with the friction and torque offset of every joint. The flexibilities of all joints are tried
as a whole too, because in a short log one link can imitate several; the significant ones are then
validated one by one.

The parameters have a normal prior, so that those without information stay nominal. To a search
they are then a source of correlated noise: the sample space is whitened by it, and the log
determinant of what it adds is the penalty (marginal likelihood).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.diagnosis.criteria import (
    ACCUSATION_PENALTY,
    JOINT_ZERO_FACTORS,
    MIN_GEOMETRIC_CAUSES,
    MIN_JOINTS_FOR_BLOCK,
    MIN_SIGMAS,
)
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.local_search import pruned
from gapbridge.core.diagnosis.selection.sample_space import CandidateFit, SampleSpace, fit
from gapbridge.core.diagnosis.selection.search import part, screened_search
from gapbridge.core.estimation.geometry import ANGLE_STD, LENGTH_STD, PRIOR_FACTORS
from gapbridge.core.estimation.least_squares import solve

Members = Callable[[SampleSpace], tuple[int, ...]]
FORBIDDEN_PENALTY = 1e9  # excludes a candidate from every set
NOMINAL = 1e-9  # 1 sigma of a parameter kept nominal, in its usual size
NONE_NOMINAL: Mapping[int, Mask] = {}


def flexibility_candidates(space: SampleSpace) -> tuple[int, ...]:
    """Return the flexibilities of all joints."""
    return tuple(c for c, k in enumerate(space.candidates) if k.effect.flexibility)


def link_candidates(space: SampleSpace, joints: bool = True) -> tuple[int, ...]:
    """Return the candidates of all links, with ``joints`` also the joints' own parameters.

    To the links' geometry belong the joints' zeros (the angle of a DH row); to the links' first
    moments friction and torque offsets.
    """
    links = [c for c, k in enumerate(space.candidates) if k.effect.estimated_as_whole]
    of_joints = [
        c for c, k in enumerate(space.candidates)
        if joints and k.effect.estimated_with_links and k.site.joint
    ]  # fmt: skip
    return (*links, *of_joints) if links else ()


def machining_tolerance(link: Candidate) -> Array:
    """Return the usual 1 sigma (d,) of a link's parameters."""
    usual = {"m": LENGTH_STD, "rad": ANGLE_STD}
    return np.array([usual.get(p.unit, p.scale) for p in link.parameters])


def prior(
    space: SampleSpace, block: Sequence[int], others: Sequence[int],
    nominal: Mapping[int, Mask] = NONE_NOMINAL,
) -> dict[int, Array]:  # fmt: skip
    """Return the prior 1 sigma (d,) of each link parameter, given the ``others`` in the set.

    ``nominal`` (d,) are parameters kept nominal.

    It is the usual machining tolerance times the power of two with the largest likelihood, because
    arms differ in precision (empirical Bayes; MacKay, Neural Computation 4 (1992) 415). The joints'
    own parameters have a factor of their own: zeros are set, not machined.
    """
    few = _reduced(space, [*block, *others])
    place = {c: k for k, c in enumerate([*block, *others])}
    size = {c: machining_tolerance(space.candidates[c]) for c in block}
    size |= {
        c: np.where(fixed, NOMINAL * size[c], size[c])
        for c, fixed in nominal.items() if c in size
    }  # fmt: skip

    def sized(links: float, joints: float) -> dict[int, Array]:
        return {
            c: (links if space.candidates[c].effect.estimated_as_whole else joints) * own
            for c, own in size.items()
        }

    def score(times: tuple[float, float]) -> float:
        links = links_of(few, {place[c]: own for c, own in sized(*times).items()})
        return _score_with_links(few, [place[c] for c in others], links) + links.penalty

    return sized(*min(itertools.product(PRIOR_FACTORS, JOINT_ZERO_FACTORS), key=score))


def _reduced(space: SampleSpace, chosen: Sequence[int]) -> SampleSpace:
    """Return the space of some candidates in few rows with the same sums of products."""
    X = np.hstack([space.columns(chosen), space.y[:, None]])
    R = np.asarray(np.linalg.qr(X, mode="r"))
    few = part(space, np.array(chosen, dtype=np.int64))
    return replace(few, X=R[:, :-1], y=R[:, -1])


@dataclass(frozen=True)
class Links:
    """The geometry of all links as noise of known size, in a sample space."""

    directions: Array  # (m, d) orthonormal
    spread: Array  # (d,) 1 sigma of the samples along each, by the prior alone

    @property
    def penalty(self) -> float:
        """Return the log determinant of the covariance that they add, in -2 log likelihood."""
        return float(np.sum(np.log1p(self.spread**2)))

    @property
    def used(self) -> float:
        """Return the effective number of parameters."""
        return float(np.sum(self.spread**2 / (1 + self.spread**2)))

    def whitened(self, columns: Array) -> Array:
        """Return columns (m, ...) whitened by the links' covariance."""
        shrinkage = 1 - 1 / np.sqrt(1 + self.spread**2)
        along = self.directions.T @ columns
        part = self.directions @ (shrinkage * along.T).T
        return np.subtract(columns, part, out=part)  # one copy of many columns, not two

    def whitened_space(self, space: SampleSpace, block: Iterable[int]) -> SampleSpace:
        """Return the space whitened by the links; their candidates ``block`` are excluded there."""
        penalty = space.penalty.copy()
        penalty[list(block)] = FORBIDDEN_PENALTY
        return replace(space, y=self.whitened(space.y), X=self.whitened(space.X), penalty=penalty)


def links_of(space: SampleSpace, sigma: Mapping[int, Array]) -> Links:
    """Return the geometry of all links in a space; ``sigma`` is the prior of each candidate."""
    size = np.concatenate(list(sigma.values()))
    U, s, _ = np.linalg.svd(space.columns(list(sigma)) * size, full_matrices=False)
    return Links(U, s)


def with_links(
    space: SampleSpace, best: CandidateFit, base: Sequence[int]
) -> tuple[SampleSpace, CandidateFit, dict[int, Array]]:
    """Return the better explanation: the set as it is, or one with all links as a cause.

    The returned space is the one in which the set was found. The links are in no set; their prior
    is returned (empty if they are no cause). They are searched for if they improve the score of the
    set, or if it has several geometric causes. Significant flexibilities are in the set itself.
    """
    tried = [_Block.of(space, best, members) for members in _block_choices(space, best)]
    if not tried:
        return space, best, {}
    block = min(tried, key=lambda b: b.score)
    sigma, links, others, score = block.sigma, block.links, block.others, block.score
    families = {c.family for c in space.candidates if c.named}
    tries = 2 * float(np.log(len(families))) + ACCUSATION_PENALTY
    geometric = [c for c in best.chosen if _geometric(space.candidates[c])]
    if len(geometric) < MIN_GEOMETRIC_CAUSES and score + tries >= best.score:
        return space, best, {}
    start = sorted({*base, *best.chosen} - set(sigma))
    start = [c for c in start if space.candidates[c].named]
    with_block = screened_search(
        space, base=start, transform=lambda p: links.whitened_space(p, block.members(p))
    )
    whitened = links.whitened_space(space, sigma)
    # the search may miss the optimum: the set found without the links is tried with them too
    with_block = min([with_block, pruned(whitened, fit(whitened, others))], key=lambda f: f.score)
    if with_block.score + links.penalty + tries < best.score:
        if block.members is flexibility_candidates:
            return space, _significant(space, (*with_block.chosen, *sigma), set(sigma)), {}
        return whitened, with_block, sigma
    return space, best, {}


def _significant(space: SampleSpace, chosen: Sequence[int], block: set[int]) -> CandidateFit:
    """Return a set without the parameters of a block that are not significant, weakest first."""
    current = fit(space, chosen)
    while True:
        strength = {
            c: float(x[0] / max(s[0], 1e-300))
            for c, x, s in zip(current.chosen, current.values, current.deviations, strict=True)
            if c in block
        }
        weakest = min(strength, key=lambda c: strength[c], default=None)
        if weakest is None or strength[weakest] >= MIN_SIGMAS:
            return current
        current = fit(space, [c for c in current.chosen if c != weakest])


@dataclass(frozen=True)
class _Block:
    """All links as one cause together with the other terms of a set."""

    members: Members
    others: list[int]  # of the set
    sigma: dict[int, Array]
    links: Links
    score: float

    @classmethod
    def of(cls, space: SampleSpace, best: CandidateFit, members: Members) -> _Block:
        block = members(space)
        others = [c for c in best.chosen if c not in block]
        sigma = prior(space, block, others)
        links = links_of(space, sigma)
        score = _score_with_links(space, others, links) + links.penalty
        return cls(members, others, sigma, links, score)


def _block_choices(space: SampleSpace, best: CandidateFit) -> list[Members]:
    """Return the blocks that may be one cause: links with or without joints, flexibilities.

    Geometry includes the joints' zeros. First moments and flexibilities are tried as a whole only
    if the set has them (or friction) at several joints.
    """
    forms: list[Members] = [link_candidates, partial(link_candidates, joints=False)]
    links = link_candidates(space)
    if links and not _of_mass(space.candidates[links[0]]):
        forms = [link_candidates]
    else:
        forms = [members for members in forms if _few_joints(space, best, members(space))]
    if _few_joints(space, best, flexibility_candidates(space)):
        forms.append(flexibility_candidates)
    return [members for members in forms if len(members(space)) > 1]


def _few_joints(space: SampleSpace, best: CandidateFit, block: Sequence[int]) -> bool:
    """Return whether a set has candidates of a block at several joints."""
    joints = {space.candidates[c].site.joint for c in best.chosen if c in block}
    return len(joints) >= MIN_JOINTS_FOR_BLOCK


def _geometric(candidate: Candidate) -> bool:
    """Return whether this is a link's geometry or the zero of a joint."""
    return candidate.effect.estimated_as_whole or (
        candidate.turns_joint_by_own_angle and not candidate.periodic
    )


def _of_mass(candidate: Candidate) -> bool:
    """Return whether a link's parameters are first moments."""
    return candidate.effect.loads_joints


def _score_with_links(space: SampleSpace, others: Sequence[int], links: Links) -> float:
    """Return the score of a set in the space whitened by the links, without their penalty."""
    A, y = links.whitened(space.columns(others)), links.whitened(space.y)
    rss = float(np.sum((y - A @ solve(A, y)) ** 2))
    return float(space.misfit(np.array(rss)) + space.penalty[list(others)].sum())
