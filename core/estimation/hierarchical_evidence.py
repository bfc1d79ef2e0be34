"""The sufficient statistics of one session for the joint flexibilities.

Poses, instrument frame and tool point are reduced to 2n equations for the 2n flexibilities; a
fleet's fit needs neither logs nor models (hierarchical.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.errors import ExcitationError
from gapbridge.core.estimation.compliance_fit import (
    Data,
    Fit,
    fit_flexibilities,
    fit_nuisances,
    residual,
    weighted_factor,
)
from gapbridge.core.estimation.flexibilities import prior_of
from gapbridge.core.estimation.identification import data_of
from gapbridge.core.estimation.least_squares import basis_of, projected_out
from gapbridge.core.estimation.robust import OUTLIER, distance_of, noise_of, scale_of
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

MIN_POSES = 4  # with an instrument that is not registered
MIN_REGISTERED = 2
RANK = 1e-9  # singular values below this share of the largest are rounding


@dataclass(frozen=True)
class Evidence:
    """Equations ``matrix @ flexibilities = right``, each with the noise of one coordinate.

    Flexibilities are axial 1..n, then radial 1..n. The tool point, and the frame of an instrument
    that is not registered, are projected out.
    """

    matrix: Array  # (2n, 2n) m per rad/Nm
    right: Array  # (2n,) m
    squares: float  # m2, remaining with the best flexibilities
    freedom: float  # coordinates minus fitted parameters
    least: float  # m, 1 sigma of one coordinate of the instrument alone
    poses: int
    outliers: int  # poses left out


def evidence(model: Model, log: Log, metrology: Metrology | None = None) -> Evidence:
    """Return the equations of a log for the flexibilities of an arm.

    They are linearised at the fit of the log. Low excitation is no error here: the equations then
    have little weight. Raises LogError where columns are missing, ExcitationError where there are
    too few poses.
    """
    metrology = metrology or Metrology()
    data, used = data_of(log, metrology)
    least = MIN_REGISTERED if metrology.registered else MIN_POSES
    if len(used) < least:
        raise ExcitationError(
            f"found {len(used)} row(s) with measured poses, expected at least {least}"
        )
    if metrology.registered:  # the tool may be bent all the same: its point alone is a nuisance
        one = np.zeros(len(used), dtype=np.int64)
        data = replace(data, session=one, sessions=1, remounted=True)
    all_free = np.ones(2 * model.arm.n, dtype=bool)
    fit = fit_flexibilities(fit_nuisances(model, data), data, all_free, prior_of(model))
    return _reduced(fit, data, metrology)


def _reduced(fit: Fit, data: Data, metrology: Metrology) -> Evidence:
    gap, _ = residual(fit.model, data, fit.frame)
    count = 2 * fit.model.arm.n
    units = _unit_factors(gap)
    inlier = _inliers(gap * units, count + data.nuisances, metrology.sigma)
    if not inlier.any():
        raise ExcitationError("found outliers alone, expected measured poses")
    gaps = gap[inlier]
    factor = weighted_factor(
        fit.model, fit.frame, data.part(inlier), (gaps, units * np.ones(gaps.shape))
    )
    F, A, b = np.split(factor, [data.nuisances, data.nuisances + count], axis=1)
    Q = basis_of(F, RANK)
    projected = projected_out(Q, np.hstack([A, b + A @ fit.flexibility[:, None]]))
    R = np.zeros((count + 1, count + 1))
    upper = np.linalg.qr(projected, mode="r")
    R[: len(upper)] = upper
    U, size, _ = np.linalg.svd(R[:count, :count])
    U = U[:, size > RANK * size.max()]
    # the part of ``right`` outside the range of the flexibilities counts as residual
    right = U @ (U.T @ R[:count, count])
    squares = float(np.sum(R[:, count] ** 2) - right @ right)
    return Evidence(
        R[:count, :count], right, max(squares, 0.0),
        max(float(gaps.size - Q.shape[1] - U.shape[1]), 0.0), metrology.sigma,
        int(inlier.sum()), int((~inlier).sum()),
    )  # fmt: skip


def _inliers(gap: Array, spent: int, least: float) -> NDArray[np.bool_]:
    """Return the rows (N,) that are no outliers.

    ``spent`` parameters were fitted to them; ``least`` (m) is the smallest noise.
    """
    # correct the residual for the fitted parameters
    share = max(1 - spent / gap.size, 0.1)
    scale = max(scale_of(gap) / np.sqrt(share), least)
    return np.asarray(distance_of(gap, scale) < OUTLIER)


def _unit_factors(gap: Array) -> Array:
    """Return factors (3,) or (6,) that scale rotations (rad) to the noise of positions (m)."""
    if gap.shape[1] == 3:
        return np.ones(3)
    position, rotation = noise_of(gap)
    return np.repeat([1.0, position / rotation], 3)
