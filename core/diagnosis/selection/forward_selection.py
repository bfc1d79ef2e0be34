"""Forward selection of sets of candidates, several in parallel (beam search)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import MAX_LINES, MAX_SMOOTH_TERMS, MIN_ORDERS_APART
from gapbridge.core.diagnosis.selection.sample_space import CandidateFit, SampleSpace, fit, gains
from gapbridge.core.estimation.least_squares import basis_of, projected_out

BEAM = 6
DEPTH = 9
PATIENCE = 2  # depths without a better set before the beam stops
DEPENDENT = 1e-5  # share of a block below which a direction counts as linearly dependent


@dataclass
class State:
    """A set with the projection of all columns and of the gap on its terms."""

    chosen: tuple[int, ...]
    basis: Array  # (m, r) orthonormal, of the chosen columns
    along: Array  # (r, K) parts of all columns along it
    r: Array  # (m,) residual
    rss: float
    score: float


def exclusive(space: SampleSpace, chosen: Sequence[int], new: int) -> bool:
    """Return whether a candidate cannot be in a set together with the chosen ones."""
    b = space.candidates[new]
    lines = 0
    if not b.named and sum(not space.candidates[c].named for c in chosen) >= MAX_SMOOTH_TERMS:
        return True
    if b.requires and b.requires not in {space.candidates[c].family for c in chosen}:
        return True
    for c in chosen:
        a = space.candidates[c]
        if not (a.named and b.named) or a.site.joint != b.site.joint:
            continue
        if a.family == b.family and a.periodic:
            lines += 1
            apart = abs((a.site.order or 0) - (b.site.order or 0))
            if apart < MIN_ORDERS_APART or lines >= MAX_LINES:
                return True
        elif a.family in (b.family, b.effect.replaces) or b.family == a.effect.replaces:
            return True
    return False


def forward_step(space: SampleSpace, state: State, new: int, score: float) -> State:
    """Return the state with one more term."""
    block = projected_out(state.basis, space.X[:, space.start[new] : space.start[new + 1]])
    U = basis_of(block, DEPENDENT)
    basis, along = np.hstack([state.basis, U]), np.vstack([state.along, U.T @ space.X])
    r = projected_out(U, state.r)
    return State((*state.chosen, new), basis, along, r, float(r @ r), score)


def projected(space: SampleSpace, chosen: Sequence[int]) -> State:
    """Return the state of a whole set."""
    U = basis_of(space.columns(chosen), DEPENDENT)
    r = projected_out(U, space.y)
    return State(tuple(chosen), U, U.T @ space.X, r, float(r @ r), 0.0)


def additions(
    space: SampleSpace, state: State, width: int, named_only: bool = False
) -> list[tuple[float, int]]:
    """Return the best terms to join a state: (score of the joint set, index), best first."""
    gain, sign = gains(space, state.r, state.along)
    score = space.misfit(np.maximum(state.rss - gain, 1e-300)) + space.penalty
    score += space.penalty[list(state.chosen)].sum()
    ranked: list[tuple[float, int]] = []
    for c in np.argsort(score):
        candidate = space.candidates[c]
        if c in state.chosen or (named_only and not candidate.named):
            continue
        if exclusive(space, state.chosen, int(c)):
            continue
        single = candidate.named and len(candidate.parameters) == 1
        if single and candidate.parameters[0].lower == 0 and sign[c] < 0:
            continue
        ranked.append((float(score[c]), int(c)))
        if len(ranked) >= width:
            break
    return ranked


def joining(space: SampleSpace, chosen: Sequence[int], width: int) -> list[tuple[float, int]]:
    """Return the best candidates to join a set: (score of the joint set, index), best first."""
    return additions(space, projected(space, chosen), width)


def beam_search(
    space: SampleSpace, allowed_depth: int = DEPTH, beam: int = BEAM, named_only: bool = False
) -> list[CandidateFit]:
    """Return the best sets tried, best first (the empty one among them)."""
    rss = float(space.y @ space.y)
    empty = replace(projected(space, ()), score=float(space.misfit(np.array(rss))))
    states, best, waited = [empty], empty.score, 0
    met: dict[frozenset[int], CandidateFit] = {frozenset(): CandidateFit((), empty.score, rss)}
    for _ in range(allowed_depth):
        born: dict[frozenset[int], tuple[float, int, int]] = {}
        for s, state in enumerate(states):
            for score, c in additions(space, state, max(2 * beam, 12), named_only):
                key = frozenset((*state.chosen, c))
                if key not in born or score < born[key][0]:
                    born[key] = (score, s, c)
        ranked = sorted(born.values())[: max(2 * beam, 12)]
        checked = []
        for _, s, c in ranked:
            found = fit(space, (*states[s].chosen, c))
            met[frozenset(found.chosen)] = found
            if np.isfinite(found.score):
                checked.append((found.score, s, c))
        checked.sort()
        states = [forward_step(space, states[s], c, score) for score, s, c in checked[:beam]]
        if not states:
            break
        waited = 0 if states[0].score < best - 1e-9 else waited + 1
        best = min(best, states[0].score)
        if waited >= PATIENCE:
            break
    return sorted(met.values(), key=lambda f: f.score)
