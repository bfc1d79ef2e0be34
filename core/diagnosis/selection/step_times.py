"""Times of steps (slips): maximum likelihood over all times between two rows, in one pass.

Every effect that steps is tried at every site and every time between two rows. The columns of a
step are those of the same change in all rows, zero before the step, so that inner products for all
times are cumulative sums. Frames and all other effects are integrated out under a wide prior, so
that they are neither mistaken for a step nor hide one. Source: Hinkley, Biometrika 57 (1970) 1.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import LOOSE_PRIOR, MIN_ROWS_BESIDE_STEP
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.state import SelectionState, flat
from gapbridge.core.effects import CATALOGUE, Effect, Site, Term

CandidateColumns = tuple[Candidate, Array]
FREE = 1e6  # prior 1 sigma of a nuisance, in its size in the noise
STEPS_PER_SITE = 3  # times of a step at one site that become candidates


def step_candidates(
    state: SelectionState,
    columns: Sequence[Array],
    base: Sequence[Term],
    withheld: Iterable[str] = (),
) -> list[CandidateColumns]:
    """Return candidates at the best times of each effect that steps, with columns (N, k, d).

    ``columns`` are those of ``state.candidates`` at the model with ``base``; a step in ``base``
    keeps its time as a further candidate.
    """
    observation = state.observation
    times, channel = observation.times, observation.channel
    effects = [
        e for name, e in CATALOGUE.items()
        if e.at_moment and channel in e.channels and name not in set(withheld)
    ]  # fmt: skip
    if times is None or not effects or len(times) < 2 * MIN_ROWS_BESIDE_STEP + 2:
        return []
    constant = tuple(t for t in base if not CATALOGUE[t.effect].at_moment)
    target, basis = _integrated(state, columns, constant)
    pairs: list[CandidateColumns] = []
    for effect in effects:
        sites = effect.sites(state.arm)
        for site in sites:
            whole_step = _step_columns(state, effect, site, constant)
            present = [t for t in base if t.effect == effect.identifier and t.site == site]
            others = tuple(t for t in base if t not in present)
            rows = _best(_gains(state, whole_step, target, basis), times)
            if others != constant:  # with a larger step still in the gap its times would win
                second = _gains(state, whole_step, _gap(state, others), basis)
                rows = list(dict.fromkeys([*rows, *_best(second, times)]))
            steps = [*(_time_before(times, k) for k in rows), *(t.values[-1] for t in present)]
            tried = max(round(len(times) / max(len({*steps}), 1)), 1)
            for step in dict.fromkeys(steps):
                candidate = _candidate(state.arm, effect, site, step, tried)
                after = (times > step).astype(float)
                pairs.append((candidate, whole_step * after[:, None, None]))
    return pairs


def _candidate(arm: Arm, effect: Effect, site: Site, step: float, tried: int) -> Candidate:
    sizes = effect.parameters(arm, site)[:-1]
    fixed = (None,) * len(sizes) + (step,)
    return Candidate(effect.identifier, site, sizes, fixed, tried=tried)


def _step_columns(state: SelectionState, effect: Effect, site: Site, base: Sequence[Term]) -> Array:
    """Return d prediction / d size (N, k, d) of a step before the first row."""
    sizes = effect.parameters(state.arm, site)[:-1]
    columns = []
    for k, parameter in enumerate(sizes):
        ends = []
        for sign in (1e-2, -1e-2):
            step = [0.0] * len(sizes)
            step[k] = sign * parameter.scale
            term = Term(effect.identifier, site, (*step, -np.inf))
            ends.append(state.observation.predict([*base, term]))
        columns.append((ends[0] - ends[1]) / (2e-2 * parameter.scale))
    return np.stack(columns, axis=-1)


def _integrated(
    state: SelectionState, columns: Sequence[Array], base: Sequence[Term]
) -> tuple[Array, Array]:
    """Return the gap (m,) and rows C (p, m) that integrate all other effects out.

    The inner product of two columns a and b is then a b - (C a)(C b).
    """
    observation = state.observation
    blocks, prior = [observation.nuisance], [np.full(observation.nuisance.shape[2], FREE)]
    for candidate, block in zip(state.candidates, columns, strict=True):
        if candidate.periodic and (candidate.site.order or 0.0) > 2.0:
            continue
        blocks.append(block)
        prior.append(LOOSE_PRIOR * candidate.scales)
    A = flat(np.concatenate(blocks, axis=2), state)
    spread = np.concatenate(prior)
    spread[: observation.nuisance.shape[2]] /= np.maximum(
        np.sqrt(np.mean(A[:, : observation.nuisance.shape[2]] ** 2, axis=0)), 1e-300
    )
    A = A * spread
    # R'R = A'A + 1 by QR, because A'A would lose the narrow priors to rounding; R'C = A'
    C = np.linalg.qr(np.vstack([A, np.eye(A.shape[1])]))[0][: len(A)].T
    return _gap(state, base), C


def _gap(state: SelectionState, base: Sequence[Term]) -> Array:
    """Return the whitened gap (m,) of the model with ``base``."""
    observation = state.observation
    return flat((observation.measured - observation.predict(base))[..., None], state)[:, 0]


def _gains(state: SelectionState, whole_step: Array, target: Array, C: Array) -> Array:
    """Return by how much a step before each row reduces the sum of squares of the gap (N,)."""
    N, k, d = whole_step.shape
    rows = np.zeros((N * k, d))
    rows[np.repeat(state.kept, k)] = flat(whole_step, state)
    kept = np.repeat(state.kept, k)
    wide = np.zeros((len(C) + 1, N * k))
    wide[:-1, kept], wide[-1, kept] = C, target

    def sum_from(values: Array) -> Array:
        """Return the sum over each row and all after it (N, ...)."""
        return np.cumsum(values[::-1], axis=0)[::-1]

    products = sum_from(np.einsum("ptj,tjd->tpd", wide.reshape(-1, N, k), rows.reshape(N, k, d)))
    gram = sum_from(np.einsum("tjd,tje->tde", rows.reshape(N, k, d), rows.reshape(N, k, d)))
    integrated, g = products[:, :-1], products[:, -1]
    g = g - np.einsum("tpd,p->td", integrated, C @ target)
    schur = gram - np.einsum("tpd,tpe->tde", integrated, integrated)
    ridge = 1e-9 * np.einsum("tdd->t", gram)[:, None, None] * np.eye(d) + 1e-300 * np.eye(d)
    return np.asarray(
        np.einsum("td,td->t", g, np.linalg.solve(schur + ridge, g[..., None])[..., 0])
    )


def _best(gain: Array, times: Array) -> list[int]:
    """Return the first rows after the best steps."""
    allowed = np.zeros(len(gain), dtype=bool)
    allowed[MIN_ROWS_BESIDE_STEP : len(gain) - MIN_ROWS_BESIDE_STEP + 1] = True
    allowed[1:] &= np.diff(times) > 0  # no step between rows of equal time
    order = np.argsort(-np.where(allowed, gain, -np.inf))
    return [int(k) for k in order[:STEPS_PER_SITE] if allowed[k]]


def _time_before(times: Array, k: int) -> float:
    return float(0.5 * (times[k - 1] + times[k]))


def slips(terms: Sequence[Term], times: Array | None) -> list[tuple[Term, float, float]]:
    """Return each step with the times of the last row before it and the first row after."""
    if times is None:
        return []
    steps = []
    for term in terms:
        if CATALOGUE[term.effect].at_moment:
            k = int(np.searchsorted(times, term.values[-1], side="right"))
            steps.append((term, float(times[max(k - 1, 0)]), float(times[min(k, len(times) - 1)])))
    return steps
