"""Held-out gaps: what a set of terms is worth on samples that its fit did not see.

Where every joint is a coordinate with a noise of its own (torques, following errors), a cause is
judged with each joint weighed by its floor, as a wrench's torques are: what a wrist of 0.1 Nm shows
twenty times over would else be lost in the noise of a shoulder of 10 Nm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.estimation.held_out import held_out_residual, random_folds

FOLDS = 10
RESAMPLES = 400


@dataclass(frozen=True)
class Shrink:
    """How far a gap shrinks once terms are in the model, on held-out samples."""

    gap_without: float  # rms per coordinate, others kept in, each joint weighed by its floor
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
        self._unprojected, self._target = selection.unprojected, selection.unprojected.target
        self._nuisance = selection.unprojected.nuisance
        k = selection.observation.measured.shape[1]
        own = {"position": 3}.get(selection.observation.channel, k)
        # torques of a wrench count in N, as their noise compares: a cause may show in them alone
        self._weight = selection.observation.weight[: min(own, k)]
        self._unwhiten = selection.unwhitener()
        self._level = _level(selection)[: min(own, k)]
        self._k, self._own = k, min(own, k)
        names, group = np.unique(selection.observation.groups[selection.kept], return_inverse=True)
        self._group, self._groups = group, len(names)
        if parts is None:
            parts = random_folds(group, FOLDS, seed)
        self.possible = int(parts.max()) > 0 and len(self._target) > self._nuisance.shape[1] + 3
        self._fold = np.repeat(parts, k)
        self._pull = selection.pull
        self._seed = seed
        self._known: dict[tuple[int, ...], Array] = {}

    def squares(self, chosen: Sequence[int]) -> Array:
        """Return the mean square of each held-out sample's own coordinates (n,), channel unit."""
        return np.asarray(np.mean(self._gap(chosen) ** 2, axis=1))

    def _levelled(self, chosen: Sequence[int]) -> Array:
        """Return the same (n,) with each joint weighed by its floor."""
        return np.asarray(np.mean((self._gap(chosen) * self._level) ** 2, axis=1))

    def _gap(self, chosen: Sequence[int]) -> Array:
        """Return each held-out sample's own coordinates (n, own), channel unit."""
        key = tuple(sorted(chosen))
        if key not in self._known:
            left = self._left(key).reshape(-1, self._k, 1)
            self._known[key] = (self._unwhiten @ left)[:, : self._own, 0] * self._weight
        return self._known[key]

    def rms(self, chosen: Sequence[int]) -> float:
        """Return the held-out rms of one coordinate, in the channel's unit."""
        return float(np.sqrt(np.mean(self.squares(chosen))))

    def _left(self, chosen: tuple[int, ...]) -> Array:
        A = np.hstack([self._unprojected.columns(self._space, chosen), self._nuisance])
        if not A.shape[1]:
            return self._target
        # with the pull: of a number that moves nothing only the pull is there
        pull = np.concatenate([self._pull(chosen), np.zeros(self._nuisance.shape[1])])
        return held_out_residual(A, self._target, self._fold, pull)

    def shrink(self, with_set: Sequence[int], without_set: Sequence[int]) -> Shrink:
        """Return how far the gap shrinks from one set to another, with its interval."""
        after, before = self._levelled(with_set), self._levelled(without_set)
        totals = np.zeros((2, self._groups))
        np.add.at(totals[0], self._group, after)
        np.add.at(totals[1], self._group, before)
        rng = np.random.default_rng(self._seed)
        draw = rng.integers(0, self._groups, (RESAMPLES, self._groups))
        sums = totals[:, draw].sum(axis=2)
        ratio = 1 - np.sqrt(sums[0] / np.maximum(sums[1], 1e-300))
        low, high = np.quantile(ratio, [0.025, 0.975])
        gap_with, gap_without = (float(np.sqrt(np.mean(s))) for s in (after, before))
        return Shrink(
            gap_without, gap_with, 1 - gap_with / max(gap_without, 1e-300),
            (float(low), float(high)),
        )  # fmt: skip


def _level(selection: Selection) -> Array:
    """Return the weight (k,) of each coordinate: joints by their floors, so that noise stays as is.

    One for coordinates that share one noise, and of a wrench, which has its own weights.
    """
    k = selection.observation.measured.shape[1]
    sigma = selection.noise.block_sigma
    if len(sigma) < k:
        return np.ones(k)
    return np.asarray(np.sqrt(np.mean(sigma**2)) / sigma)
