"""The noise of a session's readings: instrument and arm as two variance components.

The instrument's noise is the same at every pose. The arm's repeatability acts through the joint
Jacobian: it grows with the lever and correlates the coordinates. Both are estimated from the
residuals of a fit by restricted maximum likelihood (Patterson, Thompson, Biometrika 58 (1971) 545),
with a prior from the instrument's data sheet.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.estimation.least_squares import inverse
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

STEP = 1e-5  # rad, for derivatives by joint angles
INSTRUMENT_STD = 0.5  # prior 1 sigma of log(noise), with the noise of a data sheet
ROTATION_STD = 1.0  # the same of rotations, for which there is no data sheet
JOINT_STD = 1.5  # the same of the arm's repeatability where it is not declared
DECLARED_STD = 0.25  # the same where it is declared
NOISY_FACTOR = 3.0  # times the median scatter beyond which a reading's variance is raised
ROUNDS = 20
CONVERGED = 1e-3  # of log(variance)
MAX_READINGS = 250  # used for the estimate


@dataclass(frozen=True)
class Noise:
    """Variance components of the noise, and the resulting covariance of each reading."""

    sizes: Array  # (c,) 1 sigma: instrument (m), rotations in the instrument's unit, joints (rad)
    shapes: tuple[Array, ...]  # (c) of (N, k, k): variance of the equations for sizes of one

    @property
    def variance(self) -> Array:
        """Return the covariance of each reading's equations (N, k, k)."""
        pairs = zip(self.sizes, self.shapes, strict=True)
        return np.asarray(sum(s**2 * shape for s, shape in pairs))

    @property
    def whitener(self) -> Array:
        """Return W (N, k, k): W @ residual has unit variance."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.variance)))

    @property
    def instrument(self) -> float:
        """Return 1 sigma of one coordinate of an inlier, the instrument alone (m)."""
        return float(self.sizes[0])

    @property
    def joint(self) -> float:
        """Return 1 sigma of one joint's repeatability (rad)."""
        return float(self.sizes[-1])

    def coordinate(self) -> float:
        """Return 1 sigma of one coordinate, instrument and arm (m), rms over the readings."""
        k = min(self.shapes[0].shape[1], 3)
        return float(np.sqrt(np.mean(np.einsum("nii->ni", self.variance[:, :k, :k]))))


@dataclass(frozen=True)
class NoisePrior:
    """Prior of the components: mean and 1 sigma of log(variance)."""

    mean: Array
    std: Array


def prior_noise(
    model: Model, readings: Readings, observable: Observable, nuisance: Nuisance,
    instrument: Metrology,
) -> tuple[Noise, NoisePrior]:  # fmt: skip
    """Return the noise before a fit, and its prior."""
    levers = joint_jacobian(model, readings, observable, nuisance)
    k = observable.equations
    excess = _excess_variance(readings)[:, None, None]
    shapes = [np.diag(np.where(np.arange(k) < 3, observable.sigmas, 0.0) ** 2) * excess]
    sizes = [instrument.sigma]
    stds = [ROTATION_STD if observable.closes else INSTRUMENT_STD]  # manual: no data sheet
    if k > 3:  # rotations have a separate noise
        shapes.append(np.diag(np.where(np.arange(k) < 3, 0.0, observable.sigmas) ** 2) * excess)
        sizes.append(instrument.sigma)
        stds.append(ROTATION_STD)
    shapes.append(levers @ np.swapaxes(levers, 1, 2))
    lever = np.sqrt(max(float(np.mean(np.einsum("nii->ni", shapes[-1][:, :3, :3]))), 1e-12))
    declared = instrument.repeatability
    sizes.append((instrument.sigma if declared is None else max(declared, 1e-9)) / lever)
    stds.append(JOINT_STD if declared is None else DECLARED_STD)
    initial = np.array(sizes)
    return Noise(initial, tuple(shapes)), NoisePrior(2 * np.log(initial), 2 * np.array(stds))


def joint_jacobian(
    model: Model, readings: Readings, observable: Observable, nuisance: Nuisance
) -> Array:
    """Return d equations / d joint angles (N, k, n), m/rad, by central differences."""
    n = model.arm.n
    out = np.empty((len(readings), observable.equations, n))
    for j in range(n):
        step = np.zeros(n)
        step[j] = STEP
        ends = [
            observable.residual(model, replace(readings, q=readings.q + sign * step), nuisance)
            for sign in (1, -1)
        ]
        out[:, :, j] = (ends[1] - ends[0]) / (2 * STEP)
    return out


def _excess_variance(readings: Readings) -> Array:
    """Return the factor on each reading's variance (N,): 1 unless its scatter is large."""
    scatter = readings.scatter
    known = np.isfinite(scatter) & (scatter > 0)
    if known.sum() < 5:
        return np.ones(len(readings))
    ratio = np.where(known, scatter, 0.0) / np.median(scatter[known])
    return np.where(ratio > NOISY_FACTOR, ratio, 1.0) ** 2


def estimate_noise(
    noise: Noise,
    prior: NoisePrior,
    residual: Array,
    columns: Array,
    precision: Array,
    inliers: NDArray[np.bool_],
) -> Noise:
    """Return the noise of maximum posterior density for ``residual`` (N, k).

    ``columns`` (N*k, p) are those of the fit, ``precision`` (p,) the inverse prior variances of
    their values, 0 for free ones; ``residual`` is with all values at zero. ``inliers`` (N,) bool
    excludes outliers.
    """
    N, k = residual.shape
    use = np.flatnonzero(inliers)
    if len(use) > MAX_READINGS:
        use = use[np.linspace(0, len(use) - 1, MAX_READINGS).astype(int)]
    X, y = columns.reshape(N, k, -1)[use], residual[use]
    shapes = [s[use] for s in noise.shapes]
    log_variance = 2 * np.log(noise.sizes)
    for _ in range(ROUNDS):
        score, information = _likelihood(log_variance, shapes, X, y, precision)
        score = score - (log_variance - prior.mean) / prior.std**2
        information = information + np.diag(1 / prior.std**2)
        step = np.clip(np.linalg.solve(information, score), -1.5, 1.5)
        log_variance = log_variance + step
        if np.abs(step).max() < CONVERGED:
            break
    return replace(noise, sizes=np.exp(log_variance / 2))


def _likelihood(
    log_variance: Array, shapes: list[Array], X: Array, y: Array, precision: Array
) -> tuple[Array, Array]:
    """Return score (c,) and Fisher's information (c, c) of the likelihood by log(variance)."""
    N, k, p = X.shape
    V = sum(np.exp(one) * shape for one, shape in zip(log_variance, shapes, strict=True))
    W = np.linalg.inv(np.linalg.cholesky(V))
    Xw = (W @ X).reshape(N * k, p)
    core = inverse(Xw.T @ Xw + np.diag(precision))
    yw = (W @ y[..., None]).reshape(-1)
    Py = yw - Xw @ (core @ (Xw.T @ yw))
    P = np.eye(N * k) - Xw @ core @ Xw.T
    parts = [W @ (np.exp(one) * shape) @ np.swapaxes(W, 1, 2)
             for one, shape in zip(log_variance, shapes, strict=True)]  # fmt: skip
    PV = [np.einsum("anb,nbc->anc", P.reshape(N * k, N, k), part).reshape(N * k, N * k)
          for part in parts]  # fmt: skip
    score = np.empty(len(parts))
    information = np.empty((len(parts), len(parts)))
    for c, part in enumerate(parts):
        block = Py.reshape(N, k)
        inside = float(np.einsum("na,nab,nb->", block, part, block))
        score[c] = 0.5 * (inside - float(np.trace(PV[c])))
        for d in range(c + 1):
            information[c, d] = information[d, c] = 0.5 * float(np.sum(PV[c] * PV[d].T))
    return score, information
