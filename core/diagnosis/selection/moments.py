"""Moments at which something steps once: by likelihood over all of them, in one pass.

Every site of every effect that steps is tried at every moment between two rows. The columns of a
step are those of the same change in all rows, cut off before the moment, so that inner products
with all moments are running sums. Everything else that may be there (frames, and all other effects
at a few usual sizes) is integrated out under its prior, so that a step is not taken for what it is
not, nor hidden behind it. Source: Hinkley, Biometrika 57 (1970) 1.
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

Pair = tuple[Candidate, Array]
FREE = 1e6  # usual sizes of a nuisance: nothing is known of it
MOMENTS = 3  # of a site that the search looks at


def step_candidates(
    state: SelectionState,
    columns: Sequence[Array],
    base: Sequence[Term],
    withheld: Iterable[str] = (),
) -> list[Pair]:
    """Return the best moments of each effect that steps, with their columns (N, k, d).

    ``columns`` are those of ``work.candidates`` at the model of ``base``; what steps in ``base``
    keeps its moment beside the new ones.
    """
    observation = state.observation
    times, channel = observation.times, observation.channel
    effects = [
        e for name, e in CATALOGUE.items()
        if e.at_moment and channel in e.channels and name not in set(withheld)
    ]  # fmt: skip
    if times is None or not effects or len(times) < 2 * MIN_ROWS_BESIDE_STEP + 2:
        return []
    still = tuple(t for t in base if not CATALOGUE[t.effect].at_moment)
    target, basis = _integrated(state, columns, still)
    pairs: list[Pair] = []
    for effect in effects:
        sites = effect.sites(state.arm)
        for site in sites:
            always = _step_columns(state, effect, site, still)
            had = [t for t in base if t.effect == effect.identifier and t.site == site]
            rest = tuple(t for t in base if t not in had)
            kept = _best(_gains(state, always, target, basis), times)
            if rest != still:  # beside a larger step the best moments are that one's
                beside = _gains(state, always, _gap(state, rest), basis)
                kept = list(dict.fromkeys([*kept, *_best(beside, times)]))
            moments = dict.fromkeys(
                [*(_between(times, k) for k in kept), *(t.values[-1] for t in had)]
            )
            tried = max(round(len(times) / max(len(moments), 1)), 1)
            for moment in moments:
                candidate = _candidate(state.arm, effect, site, moment, tried)
                after = (times > moment).astype(float)
                pairs.append((candidate, always * after[:, None, None]))
    return pairs


def _candidate(arm: Arm, effect: Effect, site: Site, moment: float, tried: int) -> Candidate:
    sizes = effect.parameters(arm, site)[:-1]
    fixed = (None,) * len(sizes) + (moment,)
    return Candidate(effect.identifier, site, sizes, fixed, tried=tried)


def _step_columns(state: SelectionState, effect: Effect, site: Site, base: Sequence[Term]) -> Array:
    """Return d prediction / d size (N, k, d) of a step that is there in all rows."""
    sizes = effect.parameters(state.arm, site)[:-1]
    columns = []
    for k, parameter in enumerate(sizes):
        ends = []
        for way in (1e-2, -1e-2):
            step = [0.0] * len(sizes)
            step[k] = way * parameter.scale
            term = Term(effect.identifier, site, (*step, -np.inf))
            ends.append(state.observation.predict([*base, term]))
        columns.append((ends[0] - ends[1]) / (2e-2 * parameter.scale))
    return np.stack(columns, axis=-1)


def _integrated(
    state: SelectionState, columns: Sequence[Array], base: Sequence[Term]
) -> tuple[Array, Array]:
    """Return the gap (m,) and rows C (p, m) with everything else integrated out.

    For any two columns a and b the inner product is then a b - (C a)(C b).
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
    # R'R = A'A + 1 by QR: squared, wide priors would leave nothing of the narrow ones; R'C = A'
    C = np.linalg.qr(np.vstack([A, np.eye(A.shape[1])]))[0][: len(A)].T
    return _gap(state, base), C


def _gap(state: SelectionState, base: Sequence[Term]) -> Array:
    """Return what a model with ``base`` does not predict (m,)."""
    observation = state.observation
    return flat((observation.measured - observation.predict(base))[..., None], state)[:, 0]


def _gains(state: SelectionState, always: Array, target: Array, C: Array) -> Array:
    """Return what a step after each row k takes of the squares of the gap (N,)."""
    N, k, d = always.shape
    rows = np.zeros((N * k, d))
    rows[np.repeat(state.kept, k)] = flat(always, state)
    kept = np.repeat(state.kept, k)
    wide = np.zeros((len(C) + 1, N * k))
    wide[:-1, kept], wide[-1, kept] = C, target

    def since(values: Array) -> Array:
        """Return the sum over all rows after each (N, ...)."""
        return np.cumsum(values[::-1], axis=0)[::-1]

    along = since(np.einsum("ptj,tjd->tpd", wide.reshape(-1, N, k), rows.reshape(N, k, d)))
    own = since(np.einsum("tjd,tje->tde", rows.reshape(N, k, d), rows.reshape(N, k, d)))
    known, g = along[:, :-1], along[:, -1]
    g = g - np.einsum("tpd,p->td", known, C @ target)
    left = own - np.einsum("tpd,tpe->tde", known, known)
    ridge = 1e-9 * np.einsum("tdd->t", own)[:, None, None] * np.eye(d) + 1e-300 * np.eye(d)
    return np.asarray(np.einsum("td,td->t", g, np.linalg.solve(left + ridge, g[..., None])[..., 0]))


def _best(gain: Array, times: Array) -> list[int]:
    """Return the rows with which the best moments begin."""
    allowed = np.zeros(len(gain), dtype=bool)
    allowed[MIN_ROWS_BESIDE_STEP : len(gain) - MIN_ROWS_BESIDE_STEP + 1] = True
    allowed[1:] &= np.diff(times) > 0  # no moment between rows of one time
    order = np.argsort(-np.where(allowed, gain, -np.inf))
    return [int(k) for k in order[:MOMENTS] if allowed[k]]


def _between(times: Array, k: int) -> float:
    return float(0.5 * (times[k - 1] + times[k]))


def slips(terms: Sequence[Term], times: Array | None) -> list[tuple[Term, float, float]]:
    """Return each term that steps, and the times of the last row before and the first row after."""
    if times is None:
        return []
    steps = []
    for term in terms:
        if CATALOGUE[term.effect].at_moment:
            k = int(np.searchsorted(times, term.values[-1], side="right"))
            steps.append((term, float(times[max(k - 1, 0)]), float(times[min(k, len(times) - 1)])))
    return steps
