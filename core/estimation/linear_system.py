"""One linear step of a calibration: parameters and nuisances against what readings leave over.

Everything is in units of the noise; parameters are weakly held at their beginning by their usual
sizes, nuisances are free.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


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

    Parameters not ``free`` do not move. One that would pass its bound stops on it and the others
    are found anew. ``damping`` shortens the parameters' steps, in lengths of their columns.
    """
    p, moving = len(at), free.copy()
    step = np.zeros(p)
    stuck = np.zeros(p, dtype=bool)
    while True:
        fixed = System(system.J[:, moving], system.F, system.residual - system.J @ (step * ~moving))
        part, nuisance = _least_squares(fixed, at[moving], bounds, moving, damping)
        step[moving] = part
        low, high = at + step < bounds.lower, at + step > bounds.upper
        out = (low | high) & moving
        if not out.any():
            return step, nuisance, stuck
        # the one that is furthest out, in its own size, stops first
        far = np.maximum(bounds.lower - at - step, at + step - bounds.upper) / bounds.held
        first = int(np.argmax(np.where(out, far, -np.inf)))
        step[first] = (bounds.lower if low[first] else bounds.upper)[first] - at[first]
        moving[first], stuck[first] = False, True


def _least_squares(
    system: System, at: Array, bounds: Bounds, moving: Mask, damping: float
) -> tuple[Array, Array]:
    p, m = system.J.shape[1], system.F.shape[1]
    rows = [
        np.hstack([system.J, system.F]),
        np.hstack([np.diag(1 / bounds.held[moving]), np.zeros((p, m))]),
    ]
    right = [system.residual, (bounds.begin[moving] - at) / bounds.held[moving]]
    if damping > 0:
        length = np.hypot(np.linalg.norm(system.J, axis=0), 1 / bounds.held[moving])
        rows.append(np.hstack([np.diag(np.sqrt(damping) * length), np.zeros((p, m))]))
        right.append(np.zeros(p))
    A = np.vstack(rows)
    size = np.linalg.norm(A, axis=0)
    size = np.where(size > 0, size, 1.0)
    found = np.linalg.lstsq(A / size, np.concatenate(right), rcond=1e-13)[0] / size
    return found[:p], found[p:]


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
    return A, np.linalg.pinv(A.T @ A + np.diag(ridge), rcond=1e-14, hermitian=True), size
