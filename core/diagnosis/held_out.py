"""Cross-validation: the gap that a set of terms leaves on held-out samples.

Where every joint is a coordinate with a noise of its own (torques, following errors), each joint is
weighted by its noise floor: a cause at a wrist with a noise of 0.1 Nm would otherwise be lost in
the noise of a shoulder of 10 Nm.
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
    """The relative reduction of a held-out gap by adding terms to the model."""

    gap_without: float  # rms per coordinate, other terms in the model, joints weighted by floor
    gap_with: float
    shrink: float
    interval: tuple[float, float]  # 95 %, over conditions


class HeldOut:
    """Cross-validation of sets of candidates in a selection's sample space.

    Folds are random groups of conditions, or ``parts`` (n,), the fold of each kept sample from 0.
    """

    def __init__(
        self, selection: Selection, seed: int = 0, parts: NDArray[np.int64] | None = None
    ) -> None:
        self._space = selection.space
        self._unprojected, self._target = selection.unprojected, selection.unprojected.target
        self._nuisance = selection.unprojected.nuisance
        k = selection.observation.measured.shape[1]
        own = {"position": 3}.get(selection.observation.channel, k)
        # torques of a wrench count in N by the ratio of noise: a cause may act on them alone
        self._weight = selection.observation.weight[: min(own, k)]
        self._unwhiten = selection.unwhitener()
        self._joint_weight = _joint_weights(selection)[: min(own, k)]
        self._k, self._own = k, min(own, k)
        names, group = np.unique(selection.observation.groups[selection.kept], return_inverse=True)
        self._group, self._groups = group, len(names)
        if parts is None:
            parts = random_folds(group, FOLDS, seed)
        self.possible = int(parts.max()) > 0 and len(self._target) > self._nuisance.shape[1] + 3
        self._fold = np.repeat(parts, k)
        self._prior = selection.pull
        self._seed = seed
        self._known: dict[tuple[int, ...], Array] = {}

    def squares(self, chosen: Sequence[int]) -> Array:
        """Return the mean square of each held-out sample's own coordinates (n,), channel unit."""
        return np.asarray(np.mean(self._gap(chosen) ** 2, axis=1))

    def _weighted_squares(self, chosen: Sequence[int]) -> Array:
        """Return the same (n,) with each joint weighted by its noise floor."""
        return np.asarray(np.mean((self._gap(chosen) * self._joint_weight) ** 2, axis=1))

    def _gap(self, chosen: Sequence[int]) -> Array:
        """Return each held-out sample's own coordinates (n, own), channel unit."""
        key = tuple(sorted(chosen))
        if key not in self._known:
            residual = self._residuals(key).reshape(-1, self._k, 1)
            self._known[key] = (self._unwhiten @ residual)[:, : self._own, 0] * self._weight
        return self._known[key]

    def rms(self, chosen: Sequence[int]) -> float:
        """Return the held-out rms of one coordinate, in the channel's unit."""
        return float(np.sqrt(np.mean(self.squares(chosen))))

    def _residuals(self, chosen: tuple[int, ...]) -> Array:
        A = np.hstack([self._unprojected.columns(self._space, chosen), self._nuisance])
        if not A.shape[1]:
            return self._target
        # the prior keeps parameters without any effect on the data determined
        prior = np.concatenate([self._prior(chosen), np.zeros(self._nuisance.shape[1])])
        return held_out_residual(A, self._target, self._fold, prior)

    def shrink(self, with_set: Sequence[int], without_set: Sequence[int]) -> Shrink:
        """Return the reduction of the gap from one set to another, with a bootstrap interval."""
        after, before = self._weighted_squares(with_set), self._weighted_squares(without_set)
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


def _joint_weights(selection: Selection) -> Array:
    """Return the weight (k,) of each coordinate by its joint's noise; the mean noise is kept.

    1 for coordinates that share one noise, and for a wrench, which has its own weights.
    """
    k = selection.observation.measured.shape[1]
    sigma = selection.noise.block_sigma
    if len(sigma) < k:
        return np.ones(k)
    return np.asarray(np.sqrt(np.mean(sigma**2)) / sigma)
