"""Held-out gaps: what a set of terms is worth on samples that its fit did not see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.diagnosis.selection.selection import Selection

Array = NDArray[np.float64]
FOLDS = 10
RESAMPLES = 400
TINY = 1e-13  # eigenvalue of unit columns below which a direction is none


@dataclass(frozen=True)
class Shrink:
    """How far a gap shrinks once terms are in the model, on held-out samples."""

    gap_without: float  # rms per coordinate, others kept in
    gap_with: float
    shrink: float
    interval: tuple[float, float]  # 95 %, over conditions


class HeldOut:
    """Cross-validation of sets of candidates in a selection's sample space.

    Folds are conditions drawn at random, or ``parts`` (n,): numbers from 0 of each kept sample.
    """

    def __init__(
        self, selection: Selection, seed: int = 0, parts: NDArray[np.int64] | None = None
    ) -> None:
        self._space = selection.space
        self._raw, self._target = selection.unprojected, selection.unprojected.target
        self._nuisance = selection.unprojected.nuisance
        k = selection.observation.measured.shape[1]
        own = {"position": 3}.get(selection.observation.channel, k)
        # torques of a wrench count in N, as their noise compares: a cause may show in them alone
        self._weight = selection.observation.weight[: min(own, k)]
        self._unwhiten = selection.unwhitener()
        self._k, self._own = k, min(own, k)
        names, group = np.unique(selection.observation.groups[selection.kept], return_inverse=True)
        self._group, self._groups = group, len(names)
        if parts is None:
            order = np.random.default_rng(seed).permutation(len(names))
            parts = (order % min(FOLDS, len(names)))[group]
        self._folds = int(parts.max()) + 1
        self.possible = self._folds >= 2 and len(self._target) > self._nuisance.shape[1] + 3
        self._fold = np.repeat(parts, k)
        self._pull = selection.pull
        self._seed = seed
        self._known: dict[tuple[int, ...], Array] = {}

    def squares(self, chosen: Sequence[int]) -> Array:
        """Return the mean square of each held-out sample's own coordinates (n,), channel unit."""
        key = tuple(sorted(chosen))
        if key not in self._known:
            left = self._left(key).reshape(-1, self._k, 1)
            gap = (self._unwhiten @ left)[:, : self._own, 0] * self._weight
            self._known[key] = np.mean(gap**2, axis=1)
        return self._known[key]

    def rms(self, chosen: Sequence[int]) -> float:
        """Return the held-out rms of one coordinate, in the channel's unit."""
        return float(np.sqrt(np.mean(self.squares(chosen))))

    def _left(self, chosen: tuple[int, ...]) -> Array:
        A = np.hstack([self._raw.columns(self._space, chosen), self._nuisance])
        if not A.shape[1]:
            return self._target
        pull = np.concatenate([self._pull(chosen), np.zeros(self._nuisance.shape[1])])
        # with the pull: of a number that moves nothing only the pull is there
        unit = 1 / np.sqrt(np.einsum("ij,ij->j", A, A) + pull**2 + 1e-300)
        A = A * unit
        whole, g = A.T @ A + np.diag((pull * unit) ** 2), A.T @ self._target
        left = np.empty_like(self._target)
        for k in range(self._folds):
            out = self._fold == k
            own, y = A[out], self._target[out]
            inverse = np.linalg.pinv(whole - own.T @ own, rcond=TINY, hermitian=True)
            left[out] = y - own @ (inverse @ (g - own.T @ y))
        return left

    def shrink(self, with_set: Sequence[int], without_set: Sequence[int]) -> Shrink:
        """Return how far the gap shrinks from one set to another, with its interval."""
        after, before = self.squares(with_set), self.squares(without_set)
        totals = np.zeros((2, self._groups))
        np.add.at(totals[0], self._group, after)
        np.add.at(totals[1], self._group, before)
        rng = np.random.default_rng(self._seed)
        draw = rng.integers(0, self._groups, (RESAMPLES, self._groups))
        sums = totals[:, draw].sum(axis=2)
        ratio = 1 - np.sqrt(sums[0] / np.maximum(sums[1], 1e-300))
        low, high = np.quantile(ratio, [0.025, 0.975])
        gap_with, gap_without = self.rms(with_set), self.rms(without_set)
        return Shrink(
            gap_without, gap_with, 1 - gap_with / max(gap_without, 1e-300),
            (float(low), float(high)),
        )  # fmt: skip
