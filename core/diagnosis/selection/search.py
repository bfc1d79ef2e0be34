"""The search for the set of candidates that explains a gap best, penalised for hypotheses tried.

All candidates compete in one whitened sample space out of which the nuisance (frames) has been
projected. A set's score is -2 log likelihood plus a penalty per term (extended BIC, Chen and Chen
2008: it grows with the number of parameters *and* with the number of hypotheses that were tried).
Sets are built by beam search and then improved by dropping and swapping terms.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.diagnosis.criteria import LARGE_SAMPLE
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.forward_selection import (
    beam_search,
    joining,
    projected,
)
from gapbridge.core.diagnosis.selection.local_search import (
    exchanged,
    forward_selected,
    improve,
    joined_sets,
    pruned,
    with_fewest_families,
)
from gapbridge.core.diagnosis.selection.sample_space import (
    USUAL_ORDERS,
    CandidateFit,
    SampleSpace,
    fit,
    gains,
)

BEST_LINES = 10  # periodic lines of a joint that are searched
BEST_SMOOTH = 60  # smooth functions that are searched
MAX_TERMS_OF_LARGE_LOG = 40


def screened_search(
    space: SampleSpace, base: Sequence[int] = (),
    transform: Callable[[SampleSpace], SampleSpace] = lambda space: space, exchange: bool = False,
) -> CandidateFit:  # fmt: skip
    """Return the best set among the candidates worth a search, in the indices of ``space``.

    ``transform`` is applied to the space of these candidates (whitening by links); ``exchange``:
    see ``search``.
    """
    keep = screened(space, base)
    place = {int(c): i for i, c in enumerate(keep)}
    part_space = transform(part(space, keep))
    best = with_fewest_families(part_space, search(part_space, [place[c] for c in base], exchange))
    return replace(best, chosen=tuple(int(keep[c]) for c in best.chosen))


def search(space: SampleSpace, base: Sequence[int] = (), exchange: bool = False) -> CandidateFit:
    """Return the best set: named causes alone, unless adding an unnamed function improves it.

    ``base`` is a set already found (named causes), used as a further start. ``exchange``: beside
    an unnamed function of a large log a cause is exchanged for several, too.

    The catalogue is searched by itself first, because a smooth function can imitate several causes
    at once.
    """
    if len(space.y) >= LARGE_SAMPLE:
        return _deep_search(space, base, exchange)
    named = improve(space, beam_search(space, named_only=True)[0], named_only=True)
    if base:
        again = improve(space, fit(space, tuple(base)), named_only=True)
        named = min([named, again], key=lambda f: f.score)
    simplest = min([named, *joined_sets(space, named)], key=lambda f: f.score)
    if simplest is named:
        return named
    whole, better = (improve(space, f) for f in (beam_search(space)[0], simplest))
    return min([named, whole, better], key=lambda f: f.score)


def _deep_search(space: SampleSpace, base: Sequence[int], exchange: bool) -> CandidateFit:
    """Return the best set of a large log, by forward selection, since many causes separate well.

    Terms are added one by one and dropped when later ones make them redundant; an unnamed function
    is added at the end if it improves the score.
    """
    best = beam_search(space, MAX_TERMS_OF_LARGE_LOG, beam=1, named_only=True)[0]
    best = pruned(space, best)
    if base:
        again = forward_selected(space, pruned(space, fit(space, tuple(base))), named_only=True)
        best = min([best, pruned(space, again)], key=lambda f: f.score)
    extended = [fit(space, (*best.chosen, c)) for _, c in joining(space, best.chosen, 4)]
    nearest = min([best, *extended], key=lambda f: f.score)
    if nearest.score < best.score:  # an unnamed function may let further named causes in
        found = forward_selected(space, nearest, named_only=True)
        # about no terms it may only be for what is not linear
        return exchanged(space, found) if exchange and base else found
    return min([best, *joined_sets(space, best)], key=lambda f: f.score)


def weighted_by_residual(space: SampleSpace, chosen: Sequence[int], k: int) -> SampleSpace:
    """Return the space with each of its k coordinates weighted by the residual of a set."""
    values = np.concatenate([*fit(space, chosen).values, np.zeros(0)])
    residual = (space.y - space.columns(chosen) @ values).reshape(-1, k)
    size = np.maximum(np.sqrt(np.mean(residual**2, axis=0)), 1.0)
    weight = np.tile(1 / size, len(residual))
    return replace(space, y=space.y * weight, X=space.X * weight[:, None])


def screened(space: SampleSpace, base: Sequence[int] = ()) -> NDArray[np.int64]:
    """Return the candidates to search: all single causes, the best of the numerous ones.

    Of each joint's thousands of periodic lines, and of the smooth functions, those are kept that
    explain most of the gap, of the residual of all single causes, or of the residual of ``base``.
    """
    many = np.array([_many(c) for c in space.candidates])
    keep = {int(c) for c in np.flatnonzero(~many)}
    single = space.columns(sorted(keep))
    unit = single / (np.sqrt(np.einsum("ij,ij->j", single, single)) + 1e-300)
    ridge = unit.T @ unit + 1e-2 * np.eye(unit.shape[1])
    residual = space.y - unit @ np.linalg.solve(ridge, unit.T @ space.y)
    targets = [space.y, residual]
    if base:
        state = projected(space, base)
        targets.append(state.r)
    for r in targets:
        gain, _ = gains(space, r)
        pools: dict[tuple[str, int | None], list[int]] = {}
        for c in np.flatnonzero(many)[np.argsort(-(gain[many] / space.penalty[many]))]:
            candidate = space.candidates[c]
            pool = pools.setdefault((candidate.family, candidate.site.joint), [])
            if len(pool) < (BEST_LINES if candidate.named else BEST_SMOOTH):
                pool.append(int(c))
        keep.update(c for pool in pools.values() for c in pool)
    return np.array(sorted(keep | set(base)))


def _many(candidate: Candidate) -> bool:
    """Return whether a candidate is one of a numerous kind."""
    usual = candidate.site.order in USUAL_ORDERS
    return not candidate.named or (candidate.periodic and not usual)


def part(space: SampleSpace, keep: NDArray[np.int64]) -> SampleSpace:
    """Return the space with some of its candidates only."""
    columns = np.concatenate([np.arange(space.start[c], space.start[c + 1]) for c in keep])
    size = np.diff(space.start)[keep]
    return replace(
        space, X=np.ascontiguousarray(space.X[:, columns]),
        start=np.concatenate([[0], np.cumsum(size)]),
        candidates=tuple(space.candidates[c] for c in keep), penalty=space.penalty[keep],
    )  # fmt: skip
