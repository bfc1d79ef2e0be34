"""How well any choice of poses could do: the bound that optimal design theory gives.

A design that may measure each candidate pose any fraction of a time is at least as good as every
plan of whole poses. It is found by the multiplicative algorithm, and the equivalence theorem says
what is still missing: for the mean variance ``f`` of the prediction, convex in the weights ``w``,
``f(best) >= f(w) - (n max d - sum w d)`` with ``d = -df/dw``. Source: Silvey, Titterington,
Torsney, Comm. Stat. A7 (1978); Atkinson, Donev, Tobias, Optimum Experimental Designs (2007),
ch. 9-10.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.planning.information import inverse

Array = NDArray[np.float64]
ROUNDS = 150
FIRST = 30  # rounds after which poses of no weight are left out
IDLE = 1e-3  # of the mean weight


def least_possible(rows: Array, weight: Array, poses: int) -> float:
    """Return the rms deviation (m) below which no ``poses`` of these candidates can come.

    ``rows`` (R, k, P) are the candidates' equations, ``weight`` (P, P) weighs the covariance.
    """
    kept, share = np.arange(len(rows)), np.full(len(rows), poses / len(rows))
    for number in range(ROUNDS):
        if number == FIRST:
            busy = share > IDLE * poses / len(rows)
            kept, share = kept[busy], share[busy]
        pull = _pull(rows[kept], share, weight)[1]
        share = share * np.sqrt(pull)
        share *= poses / share.sum()
    value, pull = _pull(rows, _whole(share, kept, len(rows)), weight)
    missing = poses * pull.max() - share @ pull[kept]
    return float(np.sqrt(max(value - missing, 0.0)))


def _whole(share: Array, kept: NDArray[np.int64], count: int) -> Array:
    whole = np.zeros(count)
    whole[kept] = share
    return whole


def _pull(rows: Array, share: Array, weight: Array) -> tuple[float, Array]:
    """Return the mean square deviation, and its fall by each candidate's weight (R,)."""
    flat = rows.reshape(-1, rows.shape[2])
    used = np.repeat(share, rows.shape[1])
    covariance = inverse(np.eye(len(weight)) + (flat * used[:, None]).T @ flat)
    spread = covariance @ weight @ covariance
    fall = np.einsum("ip,ip->i", flat @ spread, flat).reshape(len(rows), -1).sum(axis=1)
    return float(np.sum(weight * covariance)), fall
