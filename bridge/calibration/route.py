"""A way in joint space round what stands in the way, by poses that are known to be free."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Clear = Callable[[Array], Array]
CHECKED = 60  # points of a straight way that are looked at


def route(clear: Clear, begin: Array, end: Array, known: Sequence[Array]) -> list[Array] | None:
    """Return the joints (n,) to go by between ``begin`` and ``end``; None: no way is found.

    Straight where that is free, else by one or two of the ``known`` poses, the shortest such way.
    ``clear`` tells for joints (N, n) whether they are free.
    """
    if all_free(clear, begin[None], end[None])[0]:
        return []
    nodes = np.array(known, dtype=float).reshape(-1, len(begin))
    out = np.flatnonzero(all_free(clear, np.broadcast_to(begin, nodes.shape), nodes))
    back = np.flatnonzero(all_free(clear, nodes, np.broadcast_to(end, nodes.shape)))
    ways = [[i] for i in np.intersect1d(out, back)]
    if not ways:
        pairs = [(i, j) for i in out for j in back if i != j]
        if pairs:
            first, second = np.array(pairs).T
            free = all_free(clear, nodes[first], nodes[second])
            ways = [list(pair) for pair, good in zip(pairs, free, strict=True) if good]
    if not ways:
        return None

    def length(way: Sequence[int]) -> float:
        along = np.vstack([begin, nodes[list(way)], end])
        return float(np.abs(np.diff(along, axis=0)).max(axis=1).sum())

    return [nodes[i] for i in min(ways, key=length)]


def all_free(clear: Clear, begin: Array, end: Array) -> NDArray[np.bool_]:
    """Return which straight ways (N,) from ``begin`` to ``end``, both (N, n), are free."""
    if not len(begin):
        return np.zeros(0, dtype=bool)
    share = np.linspace(0, 1, CHECKED)[:, None]
    between = begin[:, None] + share * (end - begin)[:, None]
    free = np.asarray(clear(between.reshape(-1, begin.shape[1])), dtype=bool)
    return np.asarray(free.reshape(len(begin), CHECKED).all(axis=1))
