"""Sizes of a channel's gap, with the nominal model and with the causes in it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.all_rows.row_sums import Streamed
from gapbridge.core.diagnosis.noise_floor import block_means, counted_coordinates
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.estimation.least_squares import solve


@dataclass(frozen=True)
class Sizes:
    """Sizes of a channel's gap over all inliers, in the channel's unit."""

    samples: int  # outliers included
    gap_rms: float
    gap_max: float  # vector norm of what counts in the rms
    remaining_rms: float  # rms with the causes in the model
    outliers: NDArray[np.int64]  # rows of the log
    means: Array | None  # (bins, k) of the residual, over time


def sizes_of(selection: Selection, gap: Array, remaining: Array) -> Sizes:
    """Return the sizes of a gap (N, k) and of the remaining one, in a selection's samples."""
    observation, kept = selection.observation, selection.kept
    counted = counted_coordinates(observation)

    def squares(values: Array) -> Array:
        return np.asarray((values[kept] * observation.weight)[:, :counted] ** 2)

    def rms(values: Array) -> float:
        return float(np.sqrt(np.mean(squares(values))))

    return Sizes(
        len(gap), rms(gap), float(np.sqrt(squares(gap).sum(axis=1).max())),
        rms(remaining), observation.rows[~kept], block_means(selection),
    )  # fmt: skip


def streamed_sizes(streamed: Streamed, decided: Selection, accused: Sequence[int]) -> Sizes:
    """Return the sizes over all rows of a long recording, under the ``accused`` terms."""
    weight, gap = decided.observation.weight, streamed.gap
    squares, means = streamed.remaining(decided, accused)

    def rms(values: Array) -> float:
        return float(np.sqrt(np.sum(values * weight**2) / (gap.kept * len(weight))))

    return Sizes(gap.samples, rms(gap.squares), gap.largest, rms(squares), gap.outliers, means)


def gaps(selection: Selection, chosen: Sequence[int]) -> tuple[Array, Array]:
    """Return the gap (N, k) without and with the chosen terms, the nuisance fitted each time."""
    observation = selection.observation
    term_of = dict(zip(selection.term_index, selection.terms, strict=True))
    without_and_with = []
    for terms in ([], [term_of[c] for c in chosen]):
        gap = observation.measured - observation.predict(terms)
        if observation.nuisance.shape[2]:
            W = selection.noise.whitener
            kept = selection.kept
            A = (W @ observation.nuisance)[kept].reshape(-1, observation.nuisance.shape[2])
            b = (W @ gap[..., None])[kept].ravel()
            gap = gap - observation.nuisance @ solve(A, b)
        without_and_with.append(gap)
    return without_and_with[0], without_and_with[1]
