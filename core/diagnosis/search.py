"""The search: which set of candidates explains a gap best, at the price of having tried so many.

All candidates compete in one whitened sample space out of which the nuisance (frames) has been
projected. A set's score is -2 log likelihood plus a price per term (extended BIC, Chen and Chen
2008: it grows with the number of parameters *and* with the number of hypotheses that were tried).
Sets grow in a beam and are then improved by dropping and swapping.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.diagnosis.candidate import Candidate
from core.diagnosis.space import USUAL_ORDERS, Found, Space, fit, gains

Array = NDArray[np.float64]
BEST_LINES = 10  # lines of a joint that a search looks at
BEST_SMOOTH = 60  # smooth functions that a search looks at
LARGE = 450  # rows of the sample space from which many causes are looked for, one by one
MERGED = 9  # terms up to which every pair is tried against one
BEAM = 6
DEPTH = 9
DEEP = 40  # terms that a large log may show
PATIENCE = 2  # depths without a better set before the beam stops
SMOOTH_TERMS = 2  # more unnamed functions than that tell nothing more
BY_ANGLE = ("joint_offset", "transmission_error")  # what a joint does by its own angle alone
LINES = 4  # periodic lines a joint may have


@dataclass
class _State:
    chosen: tuple[int, ...]
    P: Array  # columns with the chosen ones projected out
    r: Array
    rss: float
    score: float


def _clash(space: Space, chosen: Sequence[int], new: int) -> bool:
    """Return whether a candidate stands instead of, not beside, one that is chosen."""
    b = space.candidates[new]
    lines = 0
    if not b.named and sum(not space.candidates[c].named for c in chosen) >= SMOOTH_TERMS:
        return True
    for c in chosen:
        a = space.candidates[c]
        if not (a.named and b.named) or a.site.joint != b.site.joint:
            continue
        if a.family == b.family == "transmission_error":
            lines += 1
            if abs((a.site.order or 0) - (b.site.order or 0)) < 0.75 or lines >= LINES:
                return True
        elif a.family == b.family or {a.family, b.family} == {
            "axial_compliance",
            "stiffness_nonlinearity",
        }:
            return True
    return False


def _grow(space: Space, state: _State, new: int, score: float) -> _State:
    block = state.P[:, space.start[new] : space.start[new + 1]]
    unit = np.sqrt(np.einsum("ij,ij->j", block, block)) + 1e-300
    U, s, _ = np.linalg.svd(block / unit, full_matrices=False)
    U = U[:, s > 1e-5]
    P = state.P - U @ (U.T @ state.P)
    r = state.r - U @ (U.T @ state.r)
    return _State((*state.chosen, new), P, r, float(r @ r), score)


def _children(
    space: Space, state: _State, width: int, named_only: bool = False
) -> list[tuple[float, int]]:
    gain, sign = gains(space, state.P, state.r)
    score = space.misfit(np.maximum(state.rss - gain, 1e-300)) + space.price
    score += space.price[list(state.chosen)].sum()
    found: list[tuple[float, int]] = []
    for c in np.argsort(score):
        candidate = space.candidates[c]
        if c in state.chosen or (named_only and not candidate.named):
            continue
        if _clash(space, state.chosen, int(c)):
            continue
        single = candidate.named and len(candidate.parameters) == 1
        if single and candidate.parameters[0].lower == 0 and sign[c] < 0:
            continue
        found.append((float(score[c]), int(c)))
        if len(found) >= width:
            break
    return found


def screened(space: Space, base: Sequence[int] = ()) -> NDArray[np.int64]:
    """Return the candidates worth a search: all single causes, the best of the many alike.

    Periodic lines and smooth functions come by the thousand; of each joint's lines and of all
    smooth functions only those are kept that take most of the gap as it is, of what a fit of all
    single causes leaves, or of what ``base`` leaves.
    """
    many = np.array([_many(c) for c in space.candidates])
    keep = {int(c) for c in np.flatnonzero(~many)}
    single = space.columns(sorted(keep))
    unit = single / (np.sqrt(np.einsum("ij,ij->j", single, single)) + 1e-300)
    ridge = unit.T @ unit + 1e-2 * np.eye(unit.shape[1])
    left = space.y - unit @ np.linalg.solve(ridge, unit.T @ space.y)
    targets = [space.y, left]
    if base:
        state = _projected(space, base)
        targets.append(state.r)
    for r in targets:
        gain, _ = gains(space, space.X, r)
        pools: dict[tuple[str, int | None], list[int]] = {}
        for c in np.flatnonzero(many)[np.argsort(-(gain[many] / space.price[many]))]:
            candidate = space.candidates[c]
            pool = pools.setdefault((candidate.family, candidate.site.joint), [])
            if len(pool) < (BEST_LINES if candidate.named else BEST_SMOOTH):
                pool.append(int(c))
        keep.update(c for pool in pools.values() for c in pool)
    return np.array(sorted(keep | set(base)))


def _many(candidate: Candidate) -> bool:
    """Return whether a candidate is one of very many alike."""
    line = candidate.family == "transmission_error"
    return not candidate.named or (line and candidate.site.order not in USUAL_ORDERS)


def part(space: Space, keep: NDArray[np.int64]) -> Space:
    """Return the space with some of its candidates only."""
    columns = np.concatenate([np.arange(space.start[c], space.start[c + 1]) for c in keep])
    size = np.diff(space.start)[keep]
    return replace(
        space, X=np.ascontiguousarray(space.X[:, columns]),
        start=np.concatenate([[0], np.cumsum(size)]),
        candidates=tuple(space.candidates[c] for c in keep), price=space.price[keep],
    )  # fmt: skip


def screened_search(space: Space, depth: int = DEPTH, base: Sequence[int] = ()) -> Found:
    """Return the best set among the candidates worth a search, in the indices of ``space``."""
    keep = screened(space, base)
    place = {int(c): i for i, c in enumerate(keep)}
    found = search(part(space, keep), depth, [place[c] for c in base])
    return replace(found, chosen=tuple(int(keep[c]) for c in found.chosen))


def search(space: Space, depth: int = DEPTH, base: Sequence[int] = ()) -> Found:
    """Return the best set: named causes alone, unless an unnamed function beside them pays.

    ``base`` is a set already found (named causes), from which the search starts as well.

    The catalogue is searched by itself first, so that a smooth function, which imitates several
    causes at once, does not stand in their way.
    """
    if len(space.y) >= LARGE:
        return _deep_search(space)
    named = improve(space, beam_search(space, depth, named_only=True)[0], named_only=True)
    if base:
        again = improve(space, fit(space, tuple(base)), named_only=True)
        named = min([named, again], key=lambda f: f.score)
    joiners = {c for _, c in children(space, named.chosen, 4)}
    joiners |= {
        c for c, rival in enumerate(space.candidates) if not (rival.named or rival.quantity)
    }
    joined = [pruned(space, fit(space, (*named.chosen, c))) for c in joiners - set(named.chosen)]
    joined += packed(space, named)
    if not any(j.score < named.score for j in joined):
        return named
    whole = improve(space, unpack(space, beam_search(space, depth)[0]))
    grown = improve(space, min(joined, key=lambda f: f.score))
    return min([named, whole, grown], key=lambda f: f.score)


def pruned(space: Space, found: Found) -> Found:
    """Return the set without the terms that it is better off without, dropped one by one."""
    while found.chosen:
        better = None
        for score, c in _drops(space, found):
            if score >= found.score:
                break
            better = fit(space, tuple(o for o in found.chosen if o != c))
            if np.isfinite(better.score):
                break
        if better is None or better.score >= found.score:
            break
        found = better
    return found


def _drops(space: Space, found: Found) -> list[tuple[float, int]]:
    """Return the score of the set less each of its terms, best first, out of one inverse."""
    X = space.columns(found.chosen)
    unit = 1 / np.sqrt(np.einsum("ij,ij->j", X, X) + 1e-300)
    A = X * unit
    inverse = np.linalg.pinv(A.T @ A, rcond=1e-12, hermitian=True)
    x = inverse @ (A.T @ space.y)
    rss = float(np.sum((space.y - A @ x) ** 2))
    paid = float(space.price[list(found.chosen)].sum())
    begin, scores = 0, []
    for c in found.chosen:
        own = slice(begin, begin + len(space.candidates[c].parameters))
        begin = own.stop
        more = float(x[own] @ np.linalg.pinv(inverse[own, own], hermitian=True) @ x[own])
        scores.append((float(space.misfit(np.array(rss + more))) + paid - space.price[c], c))
    return sorted(scores)


def _deep_search(space: Space) -> Found:
    """Return the best set of a large log: many causes at once, each cheap to tell apart.

    Terms are added one by one and dropped again where later ones make them needless; an unnamed
    function joins at the end, where one still pays.
    """
    found = beam_search(space, DEEP, beam=1, named_only=True)[0]
    found = pruned(space, found)
    return min([found, *_joined(space, found), *packed(space, found)], key=lambda f: f.score)


def _joined(space: Space, found: Found) -> list[Found]:
    """Return the set with one more term, less what that makes needless: unnamed rivals above all.

    Named causes that together imitate something unknown fall away where it is given its own term.
    """
    joiners = {c for _, c in children(space, found.chosen, 4)}
    joiners |= {
        c for c, rival in enumerate(space.candidates) if not (rival.named or rival.quantity)
    }
    new = sorted(joiners - set(found.chosen))
    return [pruned(space, fit(space, (*found.chosen, c))) for c in new]


def beam_search(
    space: Space, allowed_depth: int = DEPTH, beam: int = BEAM, named_only: bool = False
) -> list[Found]:
    """Return the best sets met, best first (the empty one among them)."""
    rss = float(space.y @ space.y)
    empty = _State((), space.X, space.y, rss, float(space.misfit(np.array(rss))))
    states, best, waited = [empty], empty.score, 0
    met: dict[frozenset[int], Found] = {frozenset(): Found((), empty.score, rss)}
    for _ in range(allowed_depth):
        children: dict[frozenset[int], tuple[float, int, int]] = {}
        for s, state in enumerate(states):
            for score, c in _children(space, state, max(2 * beam, 12), named_only):
                key = frozenset((*state.chosen, c))
                if key not in children or score < children[key][0]:
                    children[key] = (score, s, c)
        ranked = sorted(children.values())[: max(2 * beam, 12)]
        checked = []
        for _, s, c in ranked:
            found = fit(space, (*states[s].chosen, c))
            met[frozenset(found.chosen)] = found
            if np.isfinite(found.score):
                checked.append((found.score, s, c))
        checked.sort()
        states = [_grow(space, states[s], c, score) for score, s, c in checked[:beam]]
        if not states:
            break
        waited = 0 if states[0].score < best - 1e-9 else waited + 1
        best = min(best, states[0].score)
        if waited >= PATIENCE:
            break
    return sorted(met.values(), key=lambda f: f.score)


def _projected(space: Space, chosen: Sequence[int]) -> _State:
    rss = float(space.y @ space.y)
    state = _State((), space.X, space.y, rss, 0.0)
    for c in chosen:
        state = _grow(space, state, c, 0.0)
    return state


def children(space: Space, chosen: Sequence[int], width: int) -> list[tuple[float, int]]:
    """Return the best candidates to join a set: (score of the joint set, index), best first."""
    return _children(space, _projected(space, chosen), width)


def improve(space: Space, found: Found, named_only: bool = False) -> Found:
    """Return the set after dropping and swapping terms as long as that pays."""
    for _ in range(4):
        better = found
        for c in found.chosen:
            rest = tuple(o for o in found.chosen if o != c)
            trial = fit(space, rest)
            if trial.score < better.score:
                better = trial
            for _, other in _children(space, _projected(space, rest), 3, named_only):
                if other != c:
                    trial = fit(space, (*rest, other))
                    if trial.score < better.score - 1e-6:
                        better = trial
        if better is found and 2 < len(found.chosen) <= MERGED:
            better = _merged(space, found, named_only)
        if better is found:
            return found
        found = better
    return found


def _merged(space: Space, found: Found, named_only: bool) -> Found:
    """Return the set with two terms replaced by one, where that pays: two that imitate a third."""
    better = found
    for i, one in enumerate(found.chosen):
        for other in found.chosen[i + 1 :]:
            rest = tuple(c for c in found.chosen if c not in (one, other))
            for _, new in _children(space, _projected(space, rest), 2, named_only):
                trial = fit(space, (*rest, new))
                if trial.score < better.score - 1e-6:
                    better = trial
    return better


def rivals(space: Space, found: Found, c: int, within: float) -> list[tuple[float, int]]:
    """Return the candidates that could stand for ``c`` in a set: (score above the best, index)."""
    rest = tuple(o for o in found.chosen if o != c)
    told = []
    for score, other in _children(space, _projected(space, rest), 40):
        if score > found.score + within:
            break
        if other == c:
            continue
        trial = fit(space, (*rest, other))
        if trial.score <= found.score + within:
            told.append((trial.score - found.score, other))
    return sorted(told)


def unpack(space: Space, found: Found) -> Found:
    """Return the set with smooth functions of a joint's own angle told as periodic lines.

    A few lines together look smooth, and each alone is dearer than one smooth function.
    """
    for c in found.chosen:
        candidate = space.candidates[c]
        joint = candidate.target.removeprefix("joint_")
        if candidate.named or not joint.isdigit():
            continue
        if candidate.quantity.rpartition("_")[2] != str(int(joint) - 1):
            continue
        rest = tuple(o for o in found.chosen if o != c)
        found = min([found, *_lines(space, rest, int(joint))], key=lambda f: f.score)
    return found


def packed(space: Space, found: Found) -> list[Found]:
    """Return sets with all that a joint does by its own angle told as one smooth function."""
    sets = []
    joints = {space.candidates[c].site.joint for c in found.chosen}
    for joint in joints - {None}:
        own = {
            c for c in found.chosen
            if space.candidates[c].site.joint == joint and space.candidates[c].family in BY_ANGLE
        }  # fmt: skip
        if len(own) < 2:
            continue
        rest = tuple(c for c in found.chosen if c not in own)
        for c, candidate in enumerate(space.candidates):
            if candidate.target == f"joint_{joint}" and candidate.quantity.endswith(
                f"l_q_{int(joint or 0) - 1}"
            ):
                sets.append(fit(space, (*rest, c)))
    return sorted(sets, key=lambda f: f.score)[:4]


def _lines(space: Space, rest: tuple[int, ...], joint: int) -> list[Found]:
    """Return the best sets of up to three lines of a joint beside ``rest``."""
    own = [
        k
        for k, candidate in enumerate(space.candidates)
        if candidate.family == "transmission_error" and candidate.site.joint == joint
    ]
    grown: list[Found] = []
    sets = [rest]
    for _ in range(3):
        step: list[Found] = []
        for chosen in sets:
            state = _projected(space, chosen)
            gain, _ = gains(space, state.P, state.r)
            ranked = sorted(own, key=lambda k: -gain[k])[:6]
            step += [fit(space, (*chosen, k)) for k in ranked if not _clash(space, chosen, k)]
        step.sort(key=lambda f: f.score)
        grown += step
        sets = [f.chosen for f in step[:5]]
    return grown
