"""Outliers: which samples are excluded, and when they are taken back in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.diagnosis.criteria import FORETOLD, WILD_SHARE, WILD_SIGMA
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.forward import children
from gapbridge.core.diagnosis.selection.noise import estimate_noise
from gapbridge.core.diagnosis.selection.problem import Found, Space, fit
from gapbridge.core.diagnosis.selection.state import Raw, Work, sample_space
from gapbridge.core.effects import Term

Array = NDArray[np.float64]
RIDGE = 5.0  # usual sizes of a parameter: prior of the fit that only looks for outliers


def look_for_wild(work: Work, columns: list[Array]) -> None:
    """Mark outliers before anything is searched: by a fit that can explain nearly anything."""
    observation = work.observation
    gap = observation.measured - observation.predict(())
    N, k = gap.shape
    usual, parts = [], []
    for c, block in zip(work.candidates, columns, strict=True):
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
        W = work.noise.whitener * np.sqrt(weight)[:, None, None]
        M, rhs = (W @ A).reshape(N * k, -1), (W @ gap[..., None]).ravel()
        G = M.T @ M
        inverse = np.linalg.pinv(G + np.diag(prior**2), rcond=1e-14, hermitian=True)
        r = gap - A @ (inverse @ (M.T @ rhs))
        used = float(np.trace(inverse @ G))
        work.kept = _keep(work, r)
        if step in (2, 5, 7):
            work.noise = estimate_noise(observation, r, work.kept, 1 - used / (N * k))
        distance = _distance(work, r)
        weight = 1 / (1 + (distance / 2) ** 2)
    work.kept = _keep(work, r)


def inliers(work: Work, residual: Array) -> NDArray[np.bool_]:
    """Return the samples (N,) that are no outliers of a residual (N, k), the nuisance refitted."""
    nuisance = work.observation.nuisance
    if nuisance.shape[2]:
        W = work.noise.whitener
        A, b = (W @ nuisance).reshape(-1, nuisance.shape[2]), (W @ residual[..., None]).ravel()
        white = (W @ residual[..., None])[..., 0]
        size = np.sqrt(np.mean(white**2, axis=1))
        row = np.repeat(size < WILD_SIGMA * np.median(size), residual.shape[1])
        residual = residual - nuisance @ np.linalg.lstsq(A[row], b[row], rcond=1e-12)[0]
    return _keep(work, residual)


def _distance(work: Work, residual: Array) -> Array:
    """Return how many standard deviations (rms over coordinates) each sample is off (N,)."""
    white = (work.noise.whitener @ residual[..., None])[..., 0]
    distance = np.sqrt(np.mean(white**2, axis=1))
    usual = np.sqrt(np.median(white**2) / 0.4549)
    return np.asarray(distance / max(usual, 1e-12))


def _keep(work: Work, residual: Array) -> NDArray[np.bool_]:
    """Return the samples to keep: all but the few wildest, and only if they are few."""
    distance = _distance(work, residual)
    wild = np.flatnonzero(distance > WILD_SIGMA)
    limit = int(np.ceil(WILD_SHARE * len(residual)))
    kept = np.ones(len(residual), dtype=bool)
    kept[wild[np.argsort(-distance[wild])][:limit]] = False
    return kept


def with_wild_explained(
    work: Work,
    columns: list[Array],
    base: tuple[Term, ...],
    smooth: list[tuple[Candidate, Array]],
    known: tuple[Space, Raw, Found],
) -> tuple[Space, Raw, Found]:
    """Take outliers back in where one local or smooth function makes them ordinary.

    A chipped tooth or a knocked instrument looks like a few outliers; bad luck has no place.
    """
    kept, found = work.kept, known[-1]
    work.kept = np.ones_like(kept)
    space, raw = sample_space(work, columns, base, smooth)
    wild = np.flatnonzero(~kept)
    for _, c in children(space, found.chosen, 12):
        if space.candidates[c].named:
            continue
        trial = fit(space, (*found.chosen, c))
        left = space.y - space.columns(trial.chosen) @ np.concatenate(trial.values)
        k = work.observation.measured.shape[1]
        distance = np.sqrt(np.mean(left.reshape(-1, k) ** 2, axis=1))
        if not (distance[wild] < WILD_SIGMA * np.median(distance)).all():
            continue
        A = np.hstack([raw.nuisance, raw.columns(space, trial.chosen)])
        d = int(space.start[c + 1] - space.start[c])
        if _foretold(A, raw.target, wild, k, d):
            return space, raw, trial
    work.kept = kept
    return known


def _foretold(A: Array, target: Array, wild: NDArray[np.int64], k: int, d: int) -> bool:
    """Return whether each outlier is mostly what the last ``d`` columns say without it.

    A flexible function can bend to any single reading; it is believed only where the others,
    outliers and inliers, indicate it beforehand.
    """
    for sample in wild:
        out = np.arange(k * sample, k * sample + k)
        rest = np.delete(np.arange(len(target)), out)
        with_it, without = A[rest], A[rest, :-d]
        x = np.linalg.lstsq(with_it, target[rest], rcond=1e-9)[0]
        plain = np.linalg.lstsq(without, target[rest], rcond=1e-9)[0]
        off = float(np.linalg.norm(target[out] - A[out] @ x))
        if off > FORETOLD * float(np.linalg.norm(target[out] - A[out, :-d] @ plain)):
            return False
    return True


def look_again(work: Work, residual: Array, free: float) -> bool:
    """Judge noise and outliers by the best explanation; returns whether those changed."""
    kept = _keep(work, residual)
    changed = bool((kept != work.kept).any())
    work.kept = kept
    work.noise = estimate_noise(work.observation, residual, kept, free)
    return changed
