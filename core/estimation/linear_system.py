"""One linear step of a calibration: parameters and nuisances against what readings leave over.

Everything is in units of the noise; parameters are weakly held at their beginning by their usual
sizes, nuisances are free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.estimation.least_squares import bounded, inverse


@dataclass(frozen=True)
class Bounds:
    """Bounds of the parameters (p,), and how firmly each is held at its beginning."""

    lower: Array
    upper: Array
    held: Array  # (p,) 1 sigma
    begin: Array  # (p,)


@dataclass(frozen=True)
class System:
    """left = J step + F nuisance step + noise, all divided by the noise."""

    J: Array  # (M, p)
    F: Array  # (M, m)
    residual: Array  # (M,)

    def weighted(self, root: Array) -> System:
        """Return the system with each equation times ``root`` (M,)."""
        return System(self.J * root[:, None], self.F * root[:, None], self.residual * root)


def solve(
    system: System, at: Array, bounds: Bounds, free: Mask, damping: float = 0.0
) -> tuple[Array, Array, Mask]:
    """Return the steps of parameters (p,) and nuisances (m,), and who ends on a bound (p,).

    Parameters not ``free`` do not move. ``damping`` shortens the parameters' steps, in lengths of
    their columns.
    """
    J, held = system.J[:, free], bounds.held[free]
    p, m = J.shape[1], system.F.shape[1]
    rows = [np.hstack([J, system.F]), np.hstack([np.diag(1 / held), np.zeros((p, m))])]
    right = [system.residual, (bounds.begin - at)[free] / held]
    if damping > 0:
        length = np.hypot(np.linalg.norm(J, axis=0), 1 / held)
        rows.append(np.hstack([np.diag(np.sqrt(damping) * length), np.zeros((p, m))]))
        right.append(np.zeros(p))
    wide = np.full(m, np.inf)
    found, on_bound = bounded(
        np.vstack(rows), np.concatenate(right),
        np.concatenate([(bounds.lower - at)[free], -wide]),
        np.concatenate([(bounds.upper - at)[free], wide]),
    )  # fmt: skip
    step, stuck = np.zeros(len(at)), np.zeros(len(at), dtype=bool)
    step[free], stuck[free] = found[:p], on_bound[:p]
    return step, found[p:], stuck


def posterior(system: System, bounds: Bounds) -> tuple[Array, float, Array]:
    """Return the parameters' covariance (p, p), the numbers spent, and each equation's share (M,).

    Bounds left aside: a parameter on its bound keeps the width that the readings give it. The
    nuisances are projected out.
    """
    p = system.J.shape[1]
    A, core, _ = _scaled_covariance(system, bounds)
    share = np.einsum("ij,jk,ik->i", A, core, A)
    covariance = core[:p, :p] * np.outer(bounds.held, bounds.held)
    return np.asarray((covariance + covariance.T) / 2), float(share.sum()), share


def joint_covariance(system: System, bounds: Bounds) -> Array:
    """Return the covariance of parameters and nuisances together (p + m, p + m)."""
    _, core, size = _scaled_covariance(system, bounds)
    return np.asarray(core / np.outer(size, size))


def _scaled_covariance(system: System, bounds: Bounds) -> tuple[Array, Array, Array]:
    """Return the columns over their ``size``, the covariance of what they multiply, and the size.

    A parameter's size is one over how firmly it is held, a nuisance's the length of its column.
    """
    nuisances = np.maximum(np.linalg.norm(system.F, axis=0), 1e-300)
    size = np.concatenate([1 / bounds.held, nuisances])
    A = np.hstack([system.J, system.F]) / size
    ridge = np.concatenate([np.ones(len(bounds.held)), np.zeros(len(nuisances))])
    return A, inverse(A.T @ A + np.diag(ridge)), size
