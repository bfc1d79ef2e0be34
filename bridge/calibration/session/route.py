"""A way in joint space round what stands in the way, by poses that are known to be free."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Clear = Callable[[Array], Array]
CHECKED = 60  # points of a straight way that are looked at
AT_ONCE = 40  # ways


def route(clear: Clear, begin: Array, end: Array, known: Sequence[Array]) -> list[Array] | None:
    """Return the joints (n,) to go by between ``begin`` and ``end``; None: no way is found.

    Straight where that is free, else by one or two of the ``known`` poses, the shortest such way.
    ``clear`` says for joints (N, n) whether they are free.
    """
    if all_free(clear, begin[None], end[None])[0]:
        return []
    nodes = np.array(known, dtype=float).reshape(-1, len(begin))
    out = np.flatnonzero(all_free(clear, np.broadcast_to(begin, nodes.shape), nodes))
    back = np.flatnonzero(all_free(clear, nodes, np.broadcast_to(end, nodes.shape)))
    for ways in ([(i,) for i in np.intersect1d(out, back)], [(i, j) for i in out for j in back]):
        found = _first_free(clear, [[begin, *nodes[list(way)], end] for way in ways])
        if found is not None:
            return found[1:-1]
    return None


def _first_free(clear: Clear, ways: list[list[Array]]) -> list[Array] | None:
    """Return the shortest way whose every leg is free."""

    def length(way: list[Array]) -> float:
        return float(np.abs(np.diff(way, axis=0)).max(axis=1).sum())

    ways = sorted(ways, key=length)
    for at in range(0, len(ways), AT_ONCE):
        some = np.array(ways[at : at + AT_ONCE])
        legs = [all_free(clear, some[:, k], some[:, k + 1]) for k in range(1, some.shape[1] - 2)]
        free = np.flatnonzero(np.all(legs, axis=0)) if legs else np.arange(len(some))
        if len(free):
            return list(some[free[0]])
    return None


def all_free(clear: Clear, begin: Array, end: Array) -> NDArray[np.bool_]:
    """Return which straight ways (N,) from ``begin`` to ``end``, both (N, n), are free."""
    if not len(begin):
        return np.zeros(0, dtype=bool)
    share = np.linspace(0, 1, CHECKED)[:, None]
    between = begin[:, None] + share * (end - begin)[:, None]
    free = np.asarray(clear(between.reshape(-1, begin.shape[1])), dtype=bool)
    return np.asarray(free.reshape(len(begin), CHECKED).all(axis=1))
