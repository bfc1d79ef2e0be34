"""The noise floor of a channel, measured independently of the residual where possible.

In order: a stated total sigma; repeats of a pose under the same load; differences of neighbouring
samples of a recording, and its resolution. Only if none of them is available, and the residual has
no structure, it is the residual's own scatter.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import (
    MIN_CORRELATED_SHARE,
    MIN_REPEATS_FOR_FLOOR,
    MIN_SAMPLES_FOR_RESIDUAL_RMS,
    NOT_WHITE_P,
)
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.selection.selection import Selection

BLOCK = 0.1  # s: shorter correlation is attributed to the sensor's filter
LAGS = 5  # of block means
MIN_BLOCKS = 40


@dataclass(frozen=True)
class Floor:
    """1 sigma of one coordinate in the channel's unit, and its source."""

    rms: float | None
    source: str  # stated, repeats, neighbouring samples, residual, unknown


@dataclass(frozen=True)
class Whiteness:
    """Whether a residual is correlated in time."""

    p_value: float  # of white noise, or noise filtered over less than BLOCK
    excess: float  # rms of the correlated part, in the channel's unit
    white: bool


def noise_floor(selection: Selection, structured: bool) -> Floor:
    """Return the noise floor of a selection's channel."""
    observation = selection.observation
    if observation.sigma_is_whole:
        return Floor(observation.sigma, "stated")
    in_unit = own_coordinates(observation)
    variance, freedom = repeat_variance(observation, selection.residual, selection.kept)
    if freedom >= MIN_REPEATS_FOR_FLOOR:
        return Floor(float(np.sqrt(max(variance, observation.sigma**2))), "repeats")
    instrument = observation.instrument and observation.instrument()
    if instrument is not None:
        measured = float(np.sqrt(np.mean(instrument[:in_unit] ** 2)))
        floor = max(measured, observation.sigma)
        return Floor(floor or None, "neighbouring samples" if floor else "unknown")
    if not structured:
        covariance = np.linalg.inv(selection.noise.whitener)
        each = np.einsum("nij,nij->ni", covariance, covariance)[:, :in_unit]
        estimated = float(np.mean(each))
        residual = selection.residual[selection.kept][:, :in_unit]
        if len(residual) >= MIN_SAMPLES_FOR_RESIDUAL_RMS:  # noise was estimated from fewer rows
            freedom_left = max(residual.size - selection.used, 1)
            estimated = max(float(np.sum(residual**2)) / freedom_left, observation.sigma**2)
        return Floor(float(np.sqrt(estimated)), "residual")
    if observation.sigma > 0:
        return Floor(observation.sigma, "stated")
    return Floor(None, "unknown")


def own_coordinates(observation: Observation) -> int:
    """Return how many coordinates have the channel's own unit."""
    k = int(observation.measured.shape[1])
    return min(k, 3) if observation.channel in ("position", "wrench") else k


def counted_coordinates(observation: Observation) -> int:
    """Return how many coordinates count in an rms: a wrench's weighted torques do."""
    k = int(observation.measured.shape[1])
    return own_coordinates(observation) if observation.channel == "position" else k


def repeat_variance(
    observation: Observation, residual: Array, kept: NDArray[np.bool_]
) -> tuple[float, int]:
    """Return the variance of one coordinate among repeats, and its degrees of freedom.

    Repeats have the same pose, session, load and approach directions.
    """
    if observation.order_in_time:
        return 0.0, 0
    in_unit = own_coordinates(observation)
    alike = [
        z for name, z in observation.quantities.items()
        if name.startswith(("payload", "actual_TCP_force", "approach_", "session"))
    ]  # fmt: skip
    table = np.column_stack([observation.groups, *(np.round(z, 3) for z in alike)])[kept]
    condition = np.unique(table, axis=0, return_inverse=True)[1].reshape(-1)
    count = np.bincount(condition)
    residual = residual[kept][:, :in_unit]
    mean = np.stack([np.bincount(condition, column) / count for column in residual.T], axis=1)
    deviation = residual - mean[condition]
    freedom = int((count - 1).sum()) * in_unit
    return float(np.sum(deviation**2)) / max(freedom, 1), freedom


def whiteness(means: Array | None, floor: float | None) -> Whiteness | None:
    """Return whether the residual of a recording is white; None for poses and short recordings.

    A portmanteau test (Ljung and Box 1978) on ``means`` (B, k) of ``block_means``, so that noise
    filtered in the sensor passes. The correlated part also has to exceed a share of the floor.
    """
    if means is None or not floor or len(means) < MIN_BLOCKS:
        return None
    return _portmanteau(means - means.mean(axis=0), floor)


def block_means(selection: Selection) -> Array | None:
    """Return the mean (B, k) of the residual over every BLOCK seconds; None for poses."""
    observation = selection.observation
    t = observation.quantities.get("timestamp")
    if not observation.order_in_time or t is None:
        return None
    kept, own = selection.kept, own_coordinates(observation)
    block = np.floor((t[kept] - t[kept][0]) / BLOCK).astype(np.int64)
    number = np.unique(block, return_inverse=True)[1].reshape(-1)
    count = np.bincount(number)
    coordinates = selection.residual[kept][:, :own]
    return np.stack([np.bincount(number, coordinates[:, j]) / count for j in range(own)], axis=1)


def _portmanteau(mean: Array, floor: float) -> Whiteness:
    from scipy.special import gammaincc

    B, own = mean.shape
    variance = np.maximum(np.mean(mean**2, axis=0), 1e-300)
    lagged = np.array([np.mean(mean[lag:] * mean[:-lag], axis=0) for lag in range(1, LAGS + 1)])
    r = lagged / variance
    weight = 1 / (B - np.arange(1, LAGS + 1))
    statistic = B * (B + 2) * np.sum(r**2 * weight[:, None], axis=0)
    p_value = min(float(gammaincc(LAGS / 2, statistic.max() / 2)) * own, 1.0)
    # the covariance at the first lag is zero for white noise
    excess = float(np.sqrt(np.mean(np.maximum(lagged[0], 0.0))))
    correlated = p_value < NOT_WHITE_P and excess > MIN_CORRELATED_SHARE * floor
    return Whiteness(p_value, excess, not correlated)
