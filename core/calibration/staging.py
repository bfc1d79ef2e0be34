"""Stages of a fit: what differs between loads first, which geometry cannot touch; then the rest.

The same pose under two loads has the same geometry: the difference of its readings is bending
alone. Flexibilities found from differences only are what the joint fit begins with, and what it is
held against afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from gapbridge.core.arrays import Array, Index, Mask
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.estimation.linear_system import Bounds, System, posterior, solve

AT_ODDS = 1e-3  # chance below which differences and everything together count as at odds


@dataclass(frozen=True)
class Stages:
    """Which parameters bending alone shows, and which readings belong together for it."""

    elastic: Mask  # (p,)
    group: Index  # (N,) readings of one pose, place and target; -1: no other load there

    @property
    def possible(self) -> bool:
        """Return whether there are differences to look at."""
        return bool(self.elastic.any() and (self.group >= 0).any())


def stages_of(parameters: Parameters, readings: Readings) -> Stages:
    """Return the stages that these readings allow."""
    effects = [CATALOGUE[parameters.terms[t].effect] for t, _ in parameters.place]
    elastic = np.array([effect.softens or effect.needs_softness for effect in effects], dtype=bool)
    group = readings.repeats()
    load = _heaviness(readings)
    for one in np.unique(group):
        own = group == one
        if len(np.unique(load[own])) < 2:
            group[own] = -1
    return Stages(elastic, group)


def _heaviness(readings: Readings) -> Index:
    """Return a number per different load (N,): the plan's, or what the readings say hung there."""
    given = (readings.load, readings.loads.payload_mass, readings.loads.wrench)
    parts = [np.round(one.reshape(len(readings), -1), 3) for one in given if one is not None]
    return np.unique(np.hstack(parts), axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)


def differences(system: System, group: Index, width: int, root: Array) -> System:
    """Return the system of the differences within groups: each group's mean taken off.

    ``root`` (N,) are the square roots of the readings' weights, with which the system is weighed
    already.
    """
    kept = np.flatnonzero(group >= 0)
    own, w = group[kept], root[kept]
    _, number = np.unique(own, return_inverse=True)
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
    system: System, stages: Stages, at: Array, bounds: Bounds, width: int, root: Array
) -> Array:
    """Return the step (p,) that differences and then geometry give, before everything together."""
    if not stages.possible:
        return np.zeros(len(at))
    apart = differences(system, stages.group, width, root)
    bending, _, _ = solve(apart, at, bounds, stages.elastic)
    rest = System(system.J, system.F, system.residual - system.J @ bending)
    geometry, _, _ = solve(rest, at + bending, bounds, ~stages.elastic)
    return bending + geometry


def at_odds(
    system: System, stages: Stages, covariance: Array, bounds: Bounds, width: int, root: Array
) -> float | None:
    """Return the chance of so much disagreement between differences and all readings, or None.

    ``system`` is at the joint fit's rest. Hausman's test: the joint estimate is the sharper one,
    so that the variance of the difference is the difference of the variances.
    """
    if not stages.possible:
        return None
    mine = stages.elastic
    apart = differences(system, stages.group, width, root)
    free = Bounds(
        np.full_like(bounds.lower, -np.inf), np.full_like(bounds.upper, np.inf),
        bounds.held, bounds.begin,
    )  # fmt: skip
    # bounds left aside on both sides: what stops on one would count as disagreement
    alone, _, _ = solve(apart, bounds.begin, free, mine)
    together, _, _ = solve(system, bounds.begin, free, np.ones_like(mine))
    off = alone - together
    part = System(apart.J[:, mine], apart.F, apart.residual)
    narrow = Bounds(bounds.lower[mine], bounds.upper[mine], bounds.held[mine], bounds.begin[mine])
    variance = posterior(part, narrow)[0] - covariance[np.ix_(mine, mine)]
    scale = 1 / bounds.held[mine]
    sizes, directions = np.linalg.eigh(variance * np.outer(scale, scale))
    seen = sizes > 1e-4  # what differences alone hardly determine is no contradiction
    seen &= sizes < 0.25
    if not seen.any():
        return None
    along = directions[:, seen].T @ (off[mine] * scale)
    return float(chi2.sf(float(np.sum(along**2 / sizes[seen])), int(seen.sum())))
