"""The noise of a session's readings: instrument and arm, separated by their lever.

An instrument's noise is the same at every pose; the arm's repeatability comes through its joints,
so that it grows with the lever and is shared between coordinates. Both sizes are estimated by
restricted maximum likelihood (Patterson, Thompson, Biometrika 58 (1971) 545) from what a fit leaves
over, the numbers that the fit spent taken off, around what is known of the instrument beforehand.
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
SURE_INSTRUMENT = 0.5  # 1 sigma of log(noise): what a data sheet is worth
SURE_TURN = 1.0  # of the noise of rotations, which nobody states
SURE_JOINT = 1.5  # of the arm's repeatability where it is not given
GIVEN = 0.25  # of the arm's repeatability where it is
NOISIER = 3.0  # times the usual scatter beyond which a reading counts as noisier than others
ROUNDS = 20
CONVERGED = 1e-3  # of log(variance)
ENOUGH = 250  # readings from which the sizes are estimated


@dataclass(frozen=True)
class Noise:
    """Sizes of the noise, and what they make of each reading."""

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

    def arm(self, rows: slice | NDArray[np.bool_] = slice(None)) -> float:
        """Return 1 sigma of one coordinate from the arm's joints (m), rms over the readings."""
        part = self.shapes[-1][rows][:, :3, :3]
        return float(self.joint * np.sqrt(np.mean(np.einsum("nii->ni", part))))

    def coordinate(self) -> float:
        """Return 1 sigma of one coordinate, instrument and arm (m), rms over the readings."""
        k = min(self.shapes[0].shape[1], 3)
        return float(np.sqrt(np.mean(np.einsum("nii->ni", self.variance[:, :k, :k]))))


@dataclass(frozen=True)
class Known:
    """What is known of the sizes beforehand: middle and 1 sigma of log(variance)."""

    middle: Array
    width: Array


def presumed(
    model: Model, readings: Readings, observable: Observable, nuisance: Nuisance,
    instrument: Metrology,
) -> tuple[Noise, Known]:  # fmt: skip
    """Return the noise as it is presumed before a fit, and how firmly."""
    levers = joint_levers(model, readings, observable, nuisance)
    k = observable.equations
    shaky = _shakiness(readings)[:, None, None]
    shapes = [np.diag(np.where(np.arange(k) < 3, observable.sigmas, 0.0) ** 2) * shaky]
    sizes = [instrument.sigma]
    sure = [SURE_TURN if observable.closes else SURE_INSTRUMENT]  # hands are not on a data sheet
    if k > 3:  # rotations have a noise of their own
        shapes.append(np.diag(np.where(np.arange(k) < 3, 0.0, observable.sigmas) ** 2) * shaky)
        sizes.append(instrument.sigma)
        sure.append(SURE_TURN)
    shapes.append(levers @ np.swapaxes(levers, 1, 2))
    lever = np.sqrt(max(float(np.mean(np.einsum("nii->ni", shapes[-1][:, :3, :3]))), 1e-12))
    given = instrument.repeatability
    sizes.append((instrument.sigma if given is None else max(given, 1e-9)) / lever)
    sure.append(SURE_JOINT if given is None else GIVEN)
    found = np.array(sizes)
    return Noise(found, tuple(shapes)), Known(2 * np.log(found), 2 * np.array(sure))


def joint_levers(
    model: Model, readings: Readings, observable: Observable, nuisance: Nuisance
) -> Array:
    """Return d equations / d joint angles (N, k, n), numerically."""
    n = model.arm.n
    out = np.empty((len(readings), observable.equations, n))
    for j in range(n):
        step = np.zeros(n)
        step[j] = STEP
        ends = [
            observable.residual(model, replace(readings, q=readings.q + way * step), nuisance)
            for way in (1, -1)
        ]
        out[:, :, j] = (ends[1] - ends[0]) / (2 * STEP)
    return out


def _shakiness(readings: Readings) -> Array:
    """Return how many times noisier than the others each reading is (N,), as a variance."""
    scatter = readings.scatter
    known = np.isfinite(scatter) & (scatter > 0)
    if known.sum() < 5:
        return np.ones(len(readings))
    ratio = np.where(known, scatter, 0.0) / np.median(scatter[known])
    return np.where(ratio > NOISIER, ratio, 1.0) ** 2


def estimated(
    noise: Noise,
    known: Known,
    residual: Array,
    columns: Array,
    precision: Array,
    kept: NDArray[np.bool_],
) -> Noise:
    """Return the noise under which ``residual`` (N, k) is most likely, around what is ``known``.

    ``columns`` (N*k, p) are what was fitted, ``precision`` (p,) the inverse variances that held
    each number around zero, 0 for those that were free; ``residual`` is what remains with all of
    them at zero. ``kept`` (N,) bool leaves outliers out.
    """
    N, k = residual.shape
    use = np.flatnonzero(kept)
    if len(use) > ENOUGH:
        use = use[np.linspace(0, len(use) - 1, ENOUGH).astype(int)]
    X, y = columns.reshape(N, k, -1)[use], residual[use]
    shapes = [s[use] for s in noise.shapes]
    t = 2 * np.log(noise.sizes)
    for _ in range(ROUNDS):
        score, curve = _likelihood(t, shapes, X, y, precision)
        score = score - (t - known.middle) / known.width**2
        curve = curve + np.diag(1 / known.width**2)
        step = np.clip(np.linalg.solve(curve, score), -1.5, 1.5)
        t = t + step
        if np.abs(step).max() < CONVERGED:
            break
    return replace(noise, sizes=np.exp(t / 2))


def _likelihood(
    t: Array, shapes: list[Array], X: Array, y: Array, precision: Array
) -> tuple[Array, Array]:
    """Return score (c,) and Fisher's information (c, c) of the likelihood by log(variance)."""
    N, k, p = X.shape
    V = sum(np.exp(one) * shape for one, shape in zip(t, shapes, strict=True))
    W = np.linalg.inv(np.linalg.cholesky(V))
    Xw = (W @ X).reshape(N * k, p)
    core = inverse(Xw.T @ Xw + np.diag(precision))
    yw = (W @ y[..., None]).reshape(-1)
    Py = yw - Xw @ (core @ (Xw.T @ yw))
    P = np.eye(N * k) - Xw @ core @ Xw.T
    parts = [W @ (np.exp(one) * shape) @ np.swapaxes(W, 1, 2)
             for one, shape in zip(t, shapes, strict=True)]  # fmt: skip
    PV = [np.einsum("anb,nbc->anc", P.reshape(N * k, N, k), part).reshape(N * k, N * k)
          for part in parts]  # fmt: skip
    score = np.empty(len(parts))
    curve = np.empty((len(parts), len(parts)))
    for c, part in enumerate(parts):
        block = Py.reshape(N, k)
        inside = float(np.einsum("na,nab,nb->", block, part, block))
        score[c] = 0.5 * (inside - float(np.trace(PV[c])))
        for d in range(c + 1):
            curve[c, d] = curve[d, c] = 0.5 * float(np.sum(PV[c] * PV[d].T))
    return score, curve
