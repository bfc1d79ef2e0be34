"""All links as one cause: many small numbers, none of which stands out alone.

The geometry of the links in positions; in torques their first moments, of which only combinations
show (base parameters; Gautier, Khalil, IEEE Trans. Robotics and Automation 6 (1990) 368), with the
friction and the zero that every joint of a real arm has. So are the flexibilities of all joints:
in a short log no tilt pays for itself, and one link that bends stands for several. They win as a
whole; those that are sure are then judged one by one.

The numbers have a prior (a normal one of an engineer's size), so that what the data do not show
stays nominal. To a search it is then one more source of correlated noise: the sample space is
whitened by it, and log det of what it adds is the penalty (marginal likelihood).
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
    FEW_LINKS,
    MIN_GEOMETRIC_CAUSES,
    OWN_SIGMAS,
    TIMES_SET,
)
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.local_search import pruned
from gapbridge.core.diagnosis.selection.problem import CandidateFit, SampleSpace, fit
from gapbridge.core.diagnosis.selection.search import part, screened_search
from gapbridge.core.estimation.geometry import ANGLE_STD, LENGTH_STD, PRIOR_FACTORS
from gapbridge.core.estimation.least_squares import solve

Members = Callable[[SampleSpace], tuple[int, ...]]
NEVER = 1e9  # a penalty that no fit is worth
NOMINAL = 1e-9  # of a number's usual size: 1 sigma of one that is held
NONE_HELD: Mapping[int, Mask] = {}


def soft_candidates(space: SampleSpace) -> tuple[int, ...]:
    """Return the flexibilities of all joints."""
    return tuple(c for c, k in enumerate(space.candidates) if k.effect.flexibility)


def link_candidates(space: SampleSpace, joints: bool = True) -> tuple[int, ...]:
    """Return the candidates of all links, and with ``joints`` what of these goes with them.

    A joint's zero is the angle in a link's DH row; in an arm whose links are all off, so are they.
    With the links' first moments go friction and the torques' zeros.
    """
    links = [c for c, k in enumerate(space.candidates) if k.effect.together]
    beside = [
        c for c, k in enumerate(space.candidates)
        if joints and k.effect.beside_links and k.site.joint
    ]  # fmt: skip
    return (*links, *beside) if links else ()


def prior(
    space: SampleSpace, block: Sequence[int], rest: Sequence[int],
    held: Mapping[int, Mask] = NONE_HELD,
) -> dict[int, Array]:  # fmt: skip
    """Return 1 sigma (d,) of each number of the links beside a set of other candidates.

    ``held`` (d,) are numbers that stay nominal.

    An engineer's size times the power of two under which the gap is most likely: arms differ in
    how well their links are known (empirical Bayes; MacKay, Neural Computation 4 (1992) 415). What
    each joint has of its own has a power of its own: its zero is set, not machined.
    """
    usual = {"m": LENGTH_STD, "rad": ANGLE_STD}
    few = _reduced(space, [*block, *rest])
    place = {c: k for k, c in enumerate([*block, *rest])}
    size = {
        c: np.array([usual.get(p.unit, p.scale) for p in space.candidates[c].parameters])
        for c in block
    }
    size |= {
        c: np.where(nominal, NOMINAL * size[c], size[c])
        for c, nominal in held.items() if c in size
    }  # fmt: skip

    def sized(links: float, joints: float) -> dict[int, Array]:
        return {
            c: (links if space.candidates[c].effect.together else joints) * own
            for c, own in size.items()
        }

    def score(times: tuple[float, float]) -> float:
        links = links_of(few, {place[c]: own for c, own in sized(*times).items()})
        return _beside_set(few, [place[c] for c in rest], links) + links.penalty

    return sized(*min(itertools.product(PRIOR_FACTORS, TIMES_SET), key=score))


def _reduced(space: SampleSpace, chosen: Sequence[int]) -> SampleSpace:
    """Return the space of some candidates, in this order, in as few rows as hold the same sums."""
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
        """Return what their numbers cost in -2 log likelihood: log det of what they add."""
        return float(np.sum(np.log1p(self.spread**2)))

    @property
    def used(self) -> float:
        """Return how many numbers the samples determine."""
        return float(np.sum(self.spread**2 / (1 + self.spread**2)))

    def whitened(self, columns: Array) -> Array:
        """Return columns (m, ...) in which the links are noise like any other."""
        less = 1 - 1 / np.sqrt(1 + self.spread**2)
        along = self.directions.T @ columns
        taken = self.directions @ (less * along.T).T
        return np.subtract(columns, taken, out=taken)  # one copy of many columns, not two

    def beside(self, space: SampleSpace, block: Iterable[int]) -> SampleSpace:
        """Return the space beside them; ``block``, their candidates, can be in no set there."""
        penalty = space.penalty.copy()
        penalty[list(block)] = NEVER
        return replace(space, y=self.whitened(space.y), X=self.whitened(space.X), penalty=penalty)


def links_of(space: SampleSpace, sigma: Mapping[int, Array]) -> Links:
    """Return the geometry of all links in a space; ``sigma`` is the prior of each candidate."""
    size = np.concatenate(list(sigma.values()))
    U, s, _ = np.linalg.svd(space.columns(list(sigma)) * size, full_matrices=False)
    return Links(U, s)


def with_links(
    space: SampleSpace, best: CandidateFit, base: Sequence[int]
) -> tuple[SampleSpace, CandidateFit, dict[int, Array]]:
    """Return the better explanation: as it is, or beside the links' geometry as a whole.

    The space returned is the one in which the set was found; the links are in no set, and their
    prior is returned (empty where they are no cause). A search beside them pays where they do so
    beside that set, or where it holds several geometric causes. Flexibilities are in the set, those
    that are sure.
    """
    tried = [_Block.of(space, best, members) for members in _forms(space, best)]
    if not tried:
        return space, best, {}
    block = min(tried, key=lambda b: b.score)
    sigma, links, rest, score = block.sigma, block.links, block.rest, block.score
    families = {c.family for c in space.candidates if c.named}
    tries = 2 * float(np.log(len(families))) + ACCUSATION_PENALTY
    kin = [c for c in best.chosen if _geometric(space.candidates[c])]
    if len(kin) < MIN_GEOMETRIC_CAUSES and score + tries >= best.score:
        return space, best, {}
    start = sorted({*base, *best.chosen} - set(sigma))
    start = [c for c in start if space.candidates[c].named]
    other = screened_search(space, base=start, beside=lambda p: links.beside(p, block.members(p)))
    near = links.beside(space, sigma)
    # a search goes its own way, and of a long log seldom the best: what was found stands beside too
    other = min([other, pruned(near, fit(near, rest))], key=lambda f: f.score)
    if other.score + links.penalty + tries < best.score:
        if block.members is soft_candidates:
            return space, _sure(space, (*other.chosen, *sigma), set(sigma)), {}
        return near, other, sigma
    return space, best, {}


def _sure(space: SampleSpace, chosen: Sequence[int], block: set[int]) -> CandidateFit:
    """Return a set less those numbers of a block that are not sure, the weakest first."""
    current = fit(space, chosen)
    while True:
        strength = {
            c: float(x[0] / max(s[0], 1e-300))
            for c, x, s in zip(current.chosen, current.values, current.deviations, strict=True)
            if c in block
        }
        weakest = min(strength, key=lambda c: strength[c], default=None)
        if weakest is None or strength[weakest] >= OWN_SIGMAS:
            return current
        current = fit(space, [c for c in current.chosen if c != weakest])


@dataclass(frozen=True)
class _Block:
    """The links as a whole beside what else a set holds, with or without their joints' own."""

    members: Members
    rest: list[int]  # of the set
    sigma: dict[int, Array]
    links: Links
    score: float

    @classmethod
    def of(cls, space: SampleSpace, best: CandidateFit, members: Members) -> _Block:
        block = members(space)
        rest = [c for c in best.chosen if c not in block]
        sigma = prior(space, block, rest)
        links = links_of(space, sigma)
        return cls(members, rest, sigma, links, _beside_set(space, rest, links) + links.penalty)


def _forms(space: SampleSpace, best: CandidateFit) -> list[Members]:
    """Return what may be a cause as a whole: the links, with what goes with them or without.

    Geometry goes with the joints' zeros. First moments can well be off singly: they are tried where
    several are, or where several joints rub; and all joints' flexibilities where several bend.
    """
    forms: list[Members] = [link_candidates, partial(link_candidates, joints=False)]
    links = link_candidates(space)
    if links and not _of_mass(space.candidates[links[0]]):
        forms = [link_candidates]
    else:
        forms = [members for members in forms if _few_joints(space, best, members(space))]
    if _few_joints(space, best, soft_candidates(space)):
        forms.append(soft_candidates)
    return [members for members in forms if len(members(space)) > 1]


def _few_joints(space: SampleSpace, best: CandidateFit, block: Sequence[int]) -> bool:
    """Return whether a set holds a few joints of a block."""
    return len({space.candidates[c].site.joint for c in best.chosen if c in block}) >= FEW_LINKS


def _geometric(candidate: Candidate) -> bool:
    """Return whether this is a link's geometry or the zero of a joint."""
    return candidate.effect.together or (candidate.turns_its_joint and not candidate.periodic)


def _of_mass(candidate: Candidate) -> bool:
    """Return whether a link's numbers are first moments: one link can well be off alone."""
    return candidate.effect.carried


def _beside_set(space: SampleSpace, rest: Sequence[int], links: Links) -> float:
    """Return the score of a set beside the links, the penalty of these left out."""
    A, y = links.whitened(space.columns(rest)), links.whitened(space.y)
    rss = float(np.sum((y - A @ solve(A, y)) ** 2))
    return float(space.misfit(np.array(rss)) + space.penalty[list(rest)].sum())
