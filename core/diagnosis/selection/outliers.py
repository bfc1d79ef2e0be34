"""Outliers: which samples are excluded, and when they are taken back in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.diagnosis.criteria import (
    MOST_OUTLIERS,
    OUTLIER_SHARE,
    OUTLIER_SIGMA,
    UNPREDICTED_SHARE,
)
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.forward import joining
from gapbridge.core.diagnosis.selection.noise import estimate_noise
from gapbridge.core.diagnosis.selection.problem import CandidateFit, SampleSpace, fit
from gapbridge.core.diagnosis.selection.state import SelectionState, UnprojectedRows, sample_space
from gapbridge.core.effects import Term

Array = NDArray[np.float64]
RIDGE = 5.0  # usual sizes of a parameter: prior of the fit that only looks for outliers


def mark_outliers(state: SelectionState, explained_by: list[tuple[Candidate, Array]]) -> None:
    """Mark outliers before anything is searched: by a fit that can explain nearly anything."""
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
        [np.full(A.shape[2], 1 / RIDGE), np.zeros(observation.nuisance.shape[2])]
    )
    A = np.concatenate([A, observation.nuisance], axis=2)
    weight, r, used = np.ones(N), gap, 0.0
    for step in range(8):
        W = state.noise.whitener * np.sqrt(weight)[:, None, None]
        M, rhs = (W @ A).reshape(N * k, -1), (W @ gap[..., None]).ravel()
        G = M.T @ M
        inverse = np.linalg.pinv(G + np.diag(prior**2), rcond=1e-14, hermitian=True)
        r = gap - A @ (inverse @ (M.T @ rhs))
        used = float(np.trace(inverse @ G))
        state.kept = _keep(state, r)
        if step in (2, 5, 7):
            state.noise = estimate_noise(observation, r, state.kept, 1 - used / (N * k))
        distance = _distance(state, r)
        weight = 1 / (1 + (distance / 2) ** 2)
    state.kept = _keep(state, r)


def inliers(state: SelectionState, residual: Array) -> NDArray[np.bool_]:
    """Return the samples (N,) that are no outliers of a residual (N, k), the nuisance refitted."""
    nuisance = state.observation.nuisance
    if nuisance.shape[2]:
        W = state.noise.whitener
        A, b = (W @ nuisance).reshape(-1, nuisance.shape[2]), (W @ residual[..., None]).ravel()
        white = (W @ residual[..., None])[..., 0]
        size = np.sqrt(np.mean(white**2, axis=1))
        row = np.repeat(size < OUTLIER_SIGMA * np.median(size), residual.shape[1])
        residual = residual - nuisance @ np.linalg.lstsq(A[row], b[row], rcond=1e-12)[0]
    return _keep(state, residual)


def _distance(state: SelectionState, residual: Array) -> Array:
    """Return how many standard deviations (rms over coordinates) each sample is off (N,)."""
    white = (state.noise.whitener @ residual[..., None])[..., 0]
    distance = np.sqrt(np.mean(white**2, axis=1))
    usual = np.sqrt(np.median(white**2) / 0.4549)
    return np.asarray(distance / max(usual, 1e-12))


def _keep(state: SelectionState, residual: Array) -> NDArray[np.bool_]:
    """Return the samples to keep: all but the farthest off, of a recording only a few of them.

    There what stands out is friction at rest or a delay rather than a bad reading.
    """
    distance = _distance(state, residual)
    outliers = np.flatnonzero(distance > OUTLIER_SIGMA)
    moving = state.observation.channel in ("torque", "tracking")
    share = OUTLIER_SHARE if moving else MOST_OUTLIERS
    limit = int(np.ceil(share * len(residual)))
    kept = np.ones(len(residual), dtype=bool)
    kept[outliers[np.argsort(-distance[outliers])][:limit]] = False
    return kept


def readmit_explained_outliers(
    state: SelectionState,
    columns: list[Array],
    base: tuple[Term, ...],
    smooth: list[tuple[Candidate, Array]],
    known: tuple[SampleSpace, UnprojectedRows, CandidateFit],
) -> tuple[SampleSpace, UnprojectedRows, CandidateFit]:
    """Take outliers back in where one local or smooth function makes them ordinary.

    A chipped tooth or a knocked instrument looks like a few outliers; bad luck has no place.
    """
    kept, found = state.kept, known[-1]
    state.kept = np.ones_like(kept)
    space, unprojected = sample_space(state, columns, base, smooth)
    outliers = np.flatnonzero(~kept)
    for _, c in joining(space, found.chosen, 12):
        if space.candidates[c].named:
            continue
        trial = fit(space, (*found.chosen, c))
        left = space.y - space.columns(trial.chosen) @ np.concatenate(trial.values)
        k = state.observation.measured.shape[1]
        distance = np.sqrt(np.mean(left.reshape(-1, k) ** 2, axis=1))
        if not (distance[outliers] < OUTLIER_SIGMA * np.median(distance)).all():
            continue
        A = np.hstack([unprojected.nuisance, unprojected.columns(space, trial.chosen)])
        d = int(space.start[c + 1] - space.start[c])
        if _predicted_without_it(A, unprojected.target, outliers, k, d):
            return space, unprojected, trial
    state.kept = kept
    return known


def _predicted_without_it(
    A: Array, target: Array, outliers: NDArray[np.int64], k: int, d: int
) -> bool:
    """Return whether each outlier is mostly what the last ``d`` columns say without it.

    A flexible function can bend to any single reading; it is believed only where the others,
    outliers and inliers, indicate it beforehand.
    """
    for sample in outliers:
        out = np.arange(k * sample, k * sample + k)
        rest = np.delete(np.arange(len(target)), out)
        with_it, without = A[rest], A[rest, :-d]
        x = np.linalg.lstsq(with_it, target[rest], rcond=1e-9)[0]
        plain = np.linalg.lstsq(without, target[rest], rcond=1e-9)[0]
        off = float(np.linalg.norm(target[out] - A[out] @ x))
        if off > UNPREDICTED_SHARE * float(np.linalg.norm(target[out] - A[out, :-d] @ plain)):
            return False
    return True


def revise_noise_and_outliers(state: SelectionState, residual: Array, free: float) -> bool:
    """Judge noise and outliers by the best explanation; returns whether those changed."""
    kept = _keep(state, residual)
    changed = bool((kept != state.kept).any())
    state.kept = kept
    state.noise = estimate_noise(state.observation, residual, kept, free)
    return changed
