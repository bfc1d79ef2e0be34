"""Stages of a fit: flexibilities from differences between loads, then the geometry.

A pose under two loads has the same geometry: the difference of its readings is due to bending
alone. Flexibilities from such differences start the joint fit, and test it afterwards (Hausman).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.stats import chi2

from gapbridge.core.arrays import Array, Index, Mask
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.estimation.linear_system import Bounds, System, posterior, solve

AT_ODDS = 1e-3  # p-value below which differences and the joint fit are inconsistent


@dataclass(frozen=True)
class Stages:
    """Which parameters act through bending, and the groups of readings of one pose."""

    elastic: Mask  # (p,)
    group: Index  # (N,) readings of one pose, place and target; -1: no other load there

    @property
    def possible(self) -> bool:
        """Return whether there are differences to look at."""
        return bool(self.elastic.any() and (self.group >= 0).any())


def stages_of(parameters: Parameters, readings: Readings) -> Stages:
    """Return the stages that these readings allow."""
    effects = [CATALOGUE[parameters.terms[t].effect] for t, _ in parameters.place]
    elastic = np.array(
        [effect.softens or effect.acts_through_deflection for effect in effects], dtype=bool
    )
    group = readings.repeats()
    load = _load_numbers(readings)
    for one in np.unique(group):
        rows = group == one
        if len(np.unique(load[rows])) < 2:
            group[rows] = -1
    return Stages(elastic, group)


def _load_numbers(readings: Readings) -> Index:
    """Return a number per distinct load (N,), by the plan and the recorded payload and wrench."""
    columns = (readings.load, readings.loads.payload_mass, readings.loads.wrench)
    parts = [np.round(one.reshape(len(readings), -1), 3) for one in columns if one is not None]
    return np.unique(np.hstack(parts), axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def differences(system: System, group: Index, width: int, root: Array) -> System:
    """Return the system of the differences within groups: each group's mean subtracted.

    ``root`` (N,) are the square roots of the readings' weights, already applied to the system.
    """
    kept = np.flatnonzero(group >= 0)
    rows, w = group[kept], root[kept]
    _, number = np.unique(rows, return_inverse=True)
    number = number.reshape(-1)
    square = np.bincount(number, w**2)
    whole = np.column_stack([system.J, system.F, system.residual])
    cells = whole.reshape(len(group), width, -1)[kept]
    sums = np.zeros((len(square), *cells.shape[1:]))
    np.add.at(sums, number, cells * w[:, None, None])
    mean = sums / np.maximum(square, 1e-12)[:, None, None]
    cells = cells - mean[number] * w[:, None, None]
    flat = cells.reshape(-1, whole.shape[1])
    p = system.J.shape[1]
    return System(flat[:, :p], flat[:, p:-1], flat[:, -1])


def staged_step(
    system: System, stages: Stages, values: Array, bounds: Bounds, width: int, root: Array
) -> Array:
    """Return the step (p,) of the flexibilities from differences, then of the geometry."""
    if not stages.possible:
        return np.zeros(len(values))
    differenced = differences(system, stages.group, width, root)
    bending, _, _ = solve(differenced, values, bounds, stages.elastic)
    remaining = System(system.J, system.F, system.residual - system.J @ bending)
    geometry, _, _ = solve(remaining, values + bending, bounds, ~stages.elastic)
    return bending + geometry


def hausman_chance(
    system: System, stages: Stages, covariance: Array, bounds: Bounds, width: int, root: Array
) -> float | None:
    """Return the p-value of flexibilities from differences against the joint fit; None: no test.

    ``system`` is that of the converged joint fit. Hausman's test: the joint estimate is the
    efficient one, so that the variance of the difference is the difference of the variances.
    """
    if not stages.possible:
        return None
    elastic = stages.elastic
    differenced = differences(system, stages.group, width, root)
    free = Bounds(
        np.full_like(bounds.lower, -np.inf), np.full_like(bounds.upper, np.inf),
        bounds.prior_std, bounds.begin,
    )  # fmt: skip
    # without bounds on either side: a value on a bound would count as disagreement
    from_differences, _, _ = solve(differenced, bounds.begin, free, elastic)
    from_all, _, _ = solve(system, bounds.begin, free, np.ones_like(elastic))
    disagreement = from_differences - from_all
    part = System(differenced.J[:, elastic], differenced.F, differenced.residual)
    elastic_bounds = Bounds(*(getattr(bounds, f.name)[elastic] for f in fields(Bounds)))
    variance = posterior(part, elastic_bounds)[0] - covariance[np.ix_(elastic, elastic)]
    scale = 1 / bounds.prior_std[elastic]
    sizes, directions = np.linalg.eigh(variance * np.outer(scale, scale))
    tested = sizes > 1e-4  # and below 0.25: directions that differences determine
    tested &= sizes < 0.25
    if not tested.any():
        return None
    along = directions[:, tested].T @ (disagreement[elastic] * scale)
    return float(chi2.sf(float(np.sum(along**2 / sizes[tested])), int(tested.sum())))
