"""The noise model of residuals, and the whitening by it.

The instrument's noise is isotropic. The arm's repeatability acts through the joints, so it grows
with the lever arm and is correlated between coordinates. Both are estimated by maximum likelihood;
the instrument's stated sigma is a lower bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.estimation.nelder_mead import nelder_mead
from gapbridge.core.estimation.robust import scale_of

MAX_JOINT_NOISE_SAMPLES = 150  # of a log from which on the noise is taken as isotropic
MAX_SAMPLES = 400  # that the noise is estimated from


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the noise, and the whitening matrices."""

    whitener: Array  # (N, k, k): whitener @ gap has unit variance in every coordinate
    block_sigma: Array  # (blocks,) 1 sigma of one coordinate, in its own unit
    joint_sigma: float  # rad, 1 sigma of one joint's repeatability; 0: not modelled
    floor_share: float  # known over total variance: lower bound of the whitened variance


def blocks(observation: Observation) -> NDArray[np.int64]:
    """Return the noise block (k,) of each coordinate; a block has one standard deviation."""
    k = observation.measured.shape[1]
    if observation.channel in ("position", "wrench"):
        return np.minimum(np.arange(k) // 3, 1)
    return np.arange(k)


def _in_unit(observation: Observation) -> NDArray[np.bool_]:
    """Return which coordinates (k,) have the channel's unit, that of its known sigma."""
    block = blocks(observation)
    return block == 0 if observation.channel in ("position", "wrench") else block >= 0


def estimate_noise(
    observation: Observation, residual: Array, kept: NDArray[np.bool_], shrink: float = 1.0
) -> Noise:
    """Return the maximum likelihood noise of ``residual`` (N, k), kept samples.

    ``shrink`` is the share of degrees of freedom that the fit has left.
    """
    block = blocks(observation)
    count = int(block.max()) + 1
    # in a large log joint noise would absorb causes that are not found yet; where each joint is a
    # coordinate, its own noise already includes it
    separable = observation.channel == "position" and len(kept) < MAX_JOINT_NOISE_SAMPLES
    J = observation.joint_columns if separable else None
    use = np.flatnonzero(kept)
    if len(use) > MAX_SAMPLES:
        use = use[:: len(use) // MAX_SAMPLES + 1]
    r = residual[use] / np.sqrt(max(shrink, 0.05))
    known = observation.sigma**2
    spread = np.array([scale_of(r[:, block == b]) for b in range(count)])
    if J is None:
        scale = np.array([max(float(np.mean(r[:, block == b] ** 2)), 1e-30) for b in range(count)])
        own = np.unique(block[_in_unit(observation)])
        scale[own] = np.maximum(scale[own], known)
        return _noise(observation, block, scale, 0.0)
    lever = J[use] @ np.swapaxes(J[use], 1, 2)
    size = np.sqrt(np.mean(np.einsum("nii->ni", lever)[:, block == 0]))
    identity = np.stack([np.diag((block == b).astype(float)) for b in range(count)])

    def surprise(x: Array) -> float:
        variance = np.exp(2 * np.clip(x, -60, 20))
        V = np.tensordot(_floored(variance[:count], known), identity, 1) + variance[-1] * lever
        _, log_size = np.linalg.slogdet(V)
        inner = np.einsum("ni,ni->n", r, np.linalg.solve(V, r[..., None])[..., 0])
        return float(np.sum(log_size + inner))

    start = np.log(np.concatenate([spread * 0.7, [0.7 * spread[0] / max(size, 1e-12)]]))
    best, _ = nelder_mead(surprise, start, 80 * len(start), 0.02, 0.05)
    variance = np.exp(2 * np.clip(best, -60, 20))
    return _noise(observation, block, _floored(variance[:count], known), float(variance[-1]))


def carried_to(observation: Observation, noise: Noise) -> Noise:
    """Return a noise estimated on other samples, for the samples of an observation."""
    return _noise(observation, blocks(observation), noise.block_sigma**2, noise.joint_sigma**2)


def _floored(variance: Array, known: float) -> Array:
    floored = variance.copy()
    floored[0] = variance[0] + known
    return floored


def _noise(
    observation: Observation, block: NDArray[np.int64], variance: Array, joint: float
) -> Noise:
    N, _k = observation.measured.shape
    V = np.tile(np.diag(variance[block]), (N, 1, 1))
    J = observation.joint_columns
    if J is not None and joint > 0:
        V = V + joint * (J @ np.swapaxes(J, 1, 2))
    whole = float(np.mean(np.einsum("nii->ni", V)[:, _in_unit(observation)]))
    known = observation.sigma**2
    if observation.sigma_is_whole and known > 0:
        factor = known / whole
        V, variance, joint, whole = V * factor, variance * factor, joint * factor, known
    whitener = np.linalg.inv(np.linalg.cholesky(V))
    share = min(known / whole, 1.0) if known > 0 else 1e-6
    return Noise(whitener, np.sqrt(variance), float(np.sqrt(joint)), share)
