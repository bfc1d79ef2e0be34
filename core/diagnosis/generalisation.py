"""Residuals to expect in another region of joint space and in another session.

Held-out poses close to fitted ones give optimistic figures. For a *new region* the folds are
regions of joint space (of a recording: stretches of time with a margin on either side); the frame
comes from the fitted poses. For a *new session* the folds are sessions: only the frame (and the
tool point, if remounted) of the held-out session is fitted on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Index
from gapbridge.core.diagnosis.criteria import MIN_FREEDOM_OF_SESSION, PRIOR_REACH
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.estimation.held_out import joint_regions
from gapbridge.core.estimation.least_squares import solve

REGIONS = 5  # of joint space, or stretches of time: each is left out whole
MIN_SAMPLES = 3  # of a region, for it to count
MARGIN = 0.02  # share of a recording, on either side of a held-out stretch, that is not fitted


@dataclass(frozen=True)
class Generalisation:
    """Residual rms of one coordinate, in the channel's unit; None: not available."""

    new_region: float | None
    new_session: float | None
    by_session: tuple[tuple[int, float], ...] = ()  # session, its rms when held out


NO_GENERALISATION = Generalisation(None, None)


def generalisation(selection: Selection, chosen: Sequence[int]) -> Generalisation:
    """Return the residuals of the ``chosen`` candidates in held-out regions and sessions."""
    problem = _HeldOutRegression(selection, tuple(chosen))
    new_region = problem.new_region()
    each = problem.by_session()
    pooled = np.concatenate([r for _, r in each]) if each else None
    return Generalisation(
        new_region, None if pooled is None else _rms(pooled), tuple((s, _rms(r)) for s, r in each)
    )


class _HeldOutRegression:
    """The regression in whitened rows of the kept samples: causes, nuisances, gap."""

    def __init__(self, selection: Selection, chosen: tuple[int, ...]) -> None:
        observation, kept = selection.observation, selection.kept
        self._k = observation.measured.shape[1]
        self._own = min(self._k, 3) if observation.channel == "position" else self._k
        self._weight = observation.weight[: self._own]
        self._unwhiten = selection.unwhitener()
        unprojected = selection.unprojected
        self._causes = unprojected.columns(selection.space, chosen)
        usual = [p.scale for c in chosen for p in selection.space.candidates[c].parameters]
        weak = 1 / (PRIOR_REACH * np.array(usual)) if usual else np.zeros(0)
        self._prior = np.maximum(selection.pull(chosen), weak)
        self._nuisance, self._gap = unprojected.nuisance, unprojected.target
        self._owner = np.array(observation.nuisance_session or (0,) * unprojected.nuisance.shape[1])
        whole = observation.session
        self._session = np.zeros(int(kept.sum()), dtype=np.int64) if whole is None else whole[kept]
        self._fold, self._near = held_out_regions(observation, kept)

    def new_region(self) -> float | None:
        """Return the rms over held-out regions, frames from the fitted poses."""
        residuals = []
        for fold in range(int(self._fold.max()) + 1):
            out = self._fold == fold
            fitted = ~out & ~self._near[fold]
            # a session needs fitted poses for its frame
            framed = [s for s in np.unique(self._session) if self._has_frame(s, fitted)]
            judged = out & np.isin(self._session, framed)
            columns = np.isin(self._owner, framed)
            A = np.hstack([self._causes, self._nuisance[:, columns]])
            fitted &= np.isin(self._session, framed)
            if judged.sum() < MIN_SAMPLES or self._k * fitted.sum() <= A.shape[1]:
                continue
            x = solve(A[self._rows(fitted)], self._gap[self._rows(fitted)], self._prior)
            rows = self._rows(judged)
            residuals.append(self._in_unit(self._gap[rows] - A[rows] @ x, judged))
        if len(residuals) < 2:
            return None
        return _rms(np.concatenate(residuals))

    def by_session(self) -> list[tuple[int, Array]]:
        """Return each session's residual (n, own) under a fit of the others, its frame fitted."""
        sessions = np.unique(self._session)
        residuals = []
        for s in sessions if len(sessions) > 1 else ():
            out = self._session == s
            other_frames, own_frame = self._owner != s, self._owner == s
            A = np.hstack([self._causes, self._nuisance[:, other_frames]])
            rows = self._rows(~out)
            if len(self._gap[rows]) <= A.shape[1]:
                continue
            x = solve(A[rows], self._gap[rows], self._prior)[: self._causes.shape[1]]
            rows = self._rows(out)
            N = self._nuisance[rows][:, own_frame]
            residual = self._gap[rows] - self._causes[rows] @ x
            residual = residual - N @ solve(N, residual)
            residuals.append((int(s), self._in_unit(residual, out)))
        return residuals

    def _has_frame(self, session: int, fitted: NDArray[np.bool_]) -> bool:
        unknowns = int((self._owner == session).sum())
        samples = int((fitted & (self._session == session)).sum())
        return bool(self._k * samples >= unknowns + MIN_FREEDOM_OF_SESSION)

    def _rows(self, samples: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return np.repeat(samples, self._k)

    def _in_unit(self, residual: Array, samples: NDArray[np.bool_]) -> Array:
        """Return whitened residuals as the channel's own coordinates (n, own)."""
        return np.asarray(
            (self._unwhiten[samples] @ residual.reshape(-1, self._k, 1))[:, : self._own, 0]
            * self._weight
        )


def held_out_regions(
    observation: Observation, kept: NDArray[np.bool_]
) -> tuple[Index, NDArray[np.bool_]]:
    """Return the region (n,) of each kept sample, and samples too close to each (folds, n)."""
    n = int(kept.sum())
    if observation.order_in_time:
        place = np.arange(n) / n
        fold = np.minimum((place * REGIONS).astype(np.int64), REGIONS - 1)
        near = np.array([
            (fold != f)
            & (place > f / REGIONS - MARGIN)
            & (place < (f + 1) / REGIONS + MARGIN)
            for f in range(REGIONS)
        ])  # fmt: skip
        return fold, near
    names = [q for q in observation.quantities if q.startswith(("actual_q_", "target_q_"))]
    if not names or n < REGIONS:
        return np.zeros(n, dtype=np.int64), np.zeros((1, n), dtype=bool)
    poses = np.stack([observation.quantities[name][kept] for name in names], axis=1)
    fold = joint_regions(poses, REGIONS)
    return fold, np.zeros((int(fold.max()) + 1, n), dtype=bool)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
