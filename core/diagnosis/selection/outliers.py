"""Outliers: which samples are excluded, and when they are readmitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import (
    LOOSE_PRIOR,
    MAX_EXCLUDED_SHARE,
    MAX_OUTLIER_SHARE,
    MAX_UNPREDICTED_SHARE,
    MIN_FREEDOM_OF_SESSION,
)
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.forward_selection import joining
from gapbridge.core.diagnosis.selection.noise import Noise, estimate_noise
from gapbridge.core.diagnosis.selection.sample_space import CandidateFit, SampleSpace, fit
from gapbridge.core.diagnosis.selection.state import SelectionState, UnprojectedRows, sample_space
from gapbridge.core.effects import Term
from gapbridge.core.estimation.least_squares import solve
from gapbridge.core.estimation.robust import (
    OUTLIER,
    distance_of,
    scale_of,
    start_weights_of,
    weights_of,
)

STARTING, STEPS = 4, 8  # steps of the robust fit: with start weights, and in all


def mark_outliers(
    state: SelectionState, explained_by: list[tuple[Candidate, Array]]
) -> SelectionState:
    """Return the state with outliers of a robust fit of all effects under a loose prior."""
    observation = state.observation
    gap = observation.measured - observation.predict(())
    N, k = gap.shape
    usual, parts = [], []
    for c, block in explained_by:
        if c.periodic and (c.site.order or 0) > 3:
            continue
        parts.append(block)
        usual += [p.scale for p in c.parameters]
    A = np.concatenate(parts, axis=2) * np.array(usual) if parts else np.zeros((N, k, 0))
    prior = np.concatenate(
        [np.full(A.shape[2], 1 / LOOSE_PRIOR), np.zeros(observation.nuisance.shape[2])]
    )
    A = np.concatenate([A, observation.nuisance], axis=2)
    weight, r, used = np.ones(N), gap, 0.0
    for step in range(STEPS):
        W = state.noise.whitener * np.sqrt(weight)[:, None, None]
        M, rhs = (W @ A).reshape(N * k, -1), (W @ gap[..., None]).ravel()
        G = M.T @ M
        inverse = np.linalg.pinv(G + np.diag(prior**2), rcond=1e-14, hermitian=True)
        r = gap - A @ (inverse @ (M.T @ rhs))
        used = float(np.trace(inverse @ G))
        state = replace(state, kept=_keep(observation, state.noise, r))
        if step in (2, 5, STEPS - 1):
            noise = estimate_noise(observation, r, state.kept, 1 - used / (N * k))
            state = replace(state, noise=noise)
        white = whitened(state.noise, r)
        distance = distance_of(white, scale_of(white))
        weight = start_weights_of(distance) if step < STARTING else weights_of(distance)
    return replace(state, kept=_keep(observation, state.noise, r))


def inliers(observation: Observation, noise: Noise, residual: Array) -> NDArray[np.bool_]:
    """Return the inliers (N,) of a residual (N, k), with the nuisance refitted."""
    nuisance = observation.nuisance
    if nuisance.shape[2]:
        W = noise.whitener
        A, b = (W @ nuisance).reshape(-1, nuisance.shape[2]), (W @ residual[..., None]).ravel()
        white = whitened(noise, residual)
        row = np.repeat(distance_of(white, scale_of(white)) < OUTLIER, residual.shape[1])
        residual = residual - nuisance @ solve(A[row], b[row])
    return _keep(observation, noise, residual)


def whitened(noise: Noise, residual: Array) -> Array:
    """Return a residual (N, k) in units of the noise."""
    return np.asarray((noise.whitener @ residual[..., None])[..., 0])


def _keep(observation: Observation, noise: Noise, residual: Array) -> NDArray[np.bool_]:
    """Return the inliers (N,): without the farthest outliers, of which a share is the limit.

    In recordings few are excluded: there they are friction at rest or delay, not bad readings.
    Those kept determine the frame, and leave something to explain.
    """
    white = whitened(noise, residual)
    distance = distance_of(white, scale_of(white))
    outliers = np.flatnonzero(distance >= OUTLIER)
    moving = observation.channel in ("torque", "tracking")
    share = MAX_OUTLIER_SHARE if moving else MAX_EXCLUDED_SHARE
    N, k, p = observation.nuisance.shape
    spare = max(N - -(-(p + MIN_FREEDOM_OF_SESSION) // k), 0)
    limit = min(int(np.ceil(share * N)), spare)
    kept = np.ones(len(residual), dtype=bool)
    kept[outliers[np.argsort(-distance[outliers])][:limit]] = False
    return kept


def readmit_explained_outliers(
    state: SelectionState,
    columns: list[Array],
    base: tuple[Term, ...],
    smooth: list[tuple[Candidate, Array]],
    known: tuple[SampleSpace, UnprojectedRows, CandidateFit],
) -> tuple[SelectionState, SampleSpace, UnprojectedRows, CandidateFit]:
    """Readmit the outliers if one smooth or local function explains all of them.

    A chipped tooth or a knocked instrument looks like a few outliers; bad readings are scattered.
    """
    best, outliers = known[-1], np.flatnonzero(~state.kept)
    whole = replace(state, kept=np.ones_like(state.kept))
    space, unprojected = sample_space(whole, columns, base, smooth)
    for _, c in joining(space, best.chosen, 12):
        if space.candidates[c].named:
            continue
        trial = fit(space, (*best.chosen, c))
        residual = space.y - space.columns(trial.chosen) @ np.concatenate(trial.values)
        k = state.observation.measured.shape[1]
        distance = distance_of(residual.reshape(-1, k), scale_of(residual))
        if not (distance[outliers] < OUTLIER).all():
            continue
        A = np.hstack([unprojected.nuisance, unprojected.columns(space, trial.chosen)])
        d = int(space.start[c + 1] - space.start[c])
        if _predicted_without_it(A, unprojected.target, outliers, k, d):
            return whole, space, unprojected, trial
    return state, *known


def _predicted_without_it(
    A: Array, target: Array, outliers: NDArray[np.int64], k: int, d: int
) -> bool:
    """Return whether the last ``d`` columns predict each outlier when it is held out.

    A flexible function can fit any single reading; it counts only if the other samples, outliers
    and inliers, predict it.
    """
    for sample in outliers:
        out = np.arange(k * sample, k * sample + k)
        others = np.delete(np.arange(len(target)), out)
        with_it, without = A[others], A[others, :-d]
        x = solve(with_it, target[others])
        plain = solve(without, target[others])
        off = float(np.linalg.norm(target[out] - A[out] @ x))
        if off > MAX_UNPREDICTED_SHARE * float(np.linalg.norm(target[out] - A[out, :-d] @ plain)):
            return False
    return True


def revise_noise_and_outliers(
    state: SelectionState, residual: Array, free: float
) -> SelectionState:
    """Return the state with noise and outliers of the best explanation's residual."""
    kept = _keep(state.observation, state.noise, residual)
    noise = estimate_noise(state.observation, residual, kept, free)
    return replace(state, kept=kept, noise=noise)
