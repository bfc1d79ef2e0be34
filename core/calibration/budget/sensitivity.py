"""Sensitivity coefficients of the TCP by the parameters of a calibration (GUM 5.1.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.result import Calibration
from gapbridge.core.calibration.spread import parameters_named
from gapbridge.core.errors import InputError


@dataclass(frozen=True)
class Sensitivity:
    """One parameter's contribution to the uncertainty of one coordinate of the TCP."""

    name: str
    unit: str
    std: float  # 1 sigma, in ``unit``
    coefficient: float  # m per ``unit``, rms over poses and axes

    @property
    def contribution(self) -> float:
        """Return the uncertainty due to this parameter alone, m."""
        return self.coefficient * self.std


@dataclass(frozen=True)
class Sensitivities:
    """All parameters, and the contribution of their correlations."""

    each: tuple[Sensitivity, ...]
    combined: float  # m, of one coordinate, all parameters with their correlations

    @property
    def correlation(self) -> float:
        """Return the contribution of correlations to the sum of squares, m2; may be negative."""
        return self.combined**2 - sum(s.contribution**2 for s in self.each)


def sensitivities(calibration: Calibration) -> Sensitivities | None:
    """Return the parameters' sensitivities at the held-out poses, at all poses without any.

    None where a parameter's name does not say which effect it belongs to.
    """
    shown, covariance = list(calibration.estimates), calibration.whole_covariance
    if len(covariance) != len(shown):
        shown, covariance = [e for e in shown if e.shown], calibration.covariance
    J = _columns(calibration, [e.name for e in shown]) if shown else None
    if J is None or len(covariance) != len(shown):
        return None
    each = tuple(
        Sensitivity(e.name, e.unit, e.std, float(np.sqrt(np.mean(J[:, :, i] ** 2))))
        for i, e in enumerate(shown)
    )
    variance = np.einsum("nip,pq,niq->n", J, covariance, J)
    return Sensitivities(each, float(np.sqrt(max(np.mean(variance), 0.0) / 3)))


def _columns(calibration: Calibration, names: list[str]) -> Array | None:
    """Return d TCP / d parameter (M, 3, p) at the calibrated model; None for an unknown name."""
    try:
        parameters = parameters_named(calibration.model, names, "calibration")
    except InputError:
        return None
    readings = calibration.readings
    chosen = readings[readings.held_out] if readings.held_out.any() else readings
    return parameters.tcp_jacobian(np.zeros(len(parameters)), chosen.q, chosen.loads)
