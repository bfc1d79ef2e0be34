"""The kernel's records in one block of memory each.

Handing a record of eleven arrays to a compiled function costs more than solving a row: each array
is unwrapped by itself. One block is unwrapped at once, and its parts are views, which both compiled
code and Python can make of it.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from gapbridge.core.arrays import Array
from gapbridge.core.kernels.reference import INNER, JIT, Chain, Rows, Shape, new_shape


def pack(record: Chain | Rows | Shape) -> Array:
    """Return a record's arrays one after the other in one block (k,)."""
    return np.concatenate([np.ravel(part) for part in record]).astype(float)


def arm_block(chain: Chain) -> Array:
    """Return an arm's chain, one row without loads, and buffers, one after the other (k,)."""
    n = chain.mass.shape[0]
    return np.concatenate([
        pack(chain), np.zeros(n), np.ones(n), np.zeros(10), pack(new_shape(n))
    ])  # fmt: skip


@njit(**JIT)
def sizes_of(n):  # type: ignore[no-untyped-def]
    """Return how many numbers a chain and one row of n joints have."""
    return 9 * (n + 1) + 3 * (n + 1) + 12 + n + 3 * n + 3 + 3 * n + 2 * n + 3, 2 * n + 10


def shape_size(n: int) -> int:
    """Return how many numbers the buffers of n joints have."""
    return 12 * (n + 1) + 15 * n + 12


@njit(**INNER)
def chain_of(block, n):  # type: ignore[no-untyped-def]
    """Return the chain of n joints whose arrays are views of ``block``."""
    a = 9 * (n + 1)
    b = a + 3 * (n + 1)
    c = b + 12
    d = c + n
    e = d + 3 * n + 3
    f = e + 3 * n
    return Chain(
        block[:a].reshape((n + 1, 3, 3)),
        block[a:b].reshape((n + 1, 3)),
        block[b : b + 9].reshape((3, 3)),
        block[b + 9 : c],
        block[c:d],
        block[d : e - 3].reshape((n, 3)),
        block[e - 3 : e],
        block[e:f].reshape((n, 3)),
        block[f : f + n],
        block[f + n : f + 2 * n],
        block[f + 2 * n : f + 2 * n + 3],
    )


def view_row(block: Array, n: int) -> Rows:
    """Return one row for n joints whose arrays are views of ``block``."""
    m = 2 * n
    return Rows(
        block[:n].reshape((1, n)),
        block[n:m].reshape((1, n)),
        block[m : m + 1],
        block[m + 1 : m + 4].reshape((1, 3)),
        block[m + 4 : m + 10].reshape((1, 6)),
    )


row_of = njit(**JIT)(view_row)


def view_shape(block: Array, n: int) -> Shape:
    """Return the buffers for n joints whose arrays are views of ``block``."""
    a = 3 * (n + 1)
    b = a + 9 * (n + 1)
    c = b + 3 * n
    d = c + 3 * n
    e = d + 3 * n
    f = e + 6 * n
    return Shape(
        block[:a].reshape((n + 1, 3)),
        block[a:b].reshape((n + 1, 3, 3)),
        block[b:c].reshape((n, 3)),
        block[c:d].reshape((n, 3)),
        block[d:e].reshape((n, 3)),
        block[e:f].reshape((n, 6)),
        block[f : f + 3],
        block[f + 3 : f + 12].reshape((3, 3)),
    )


shape_of = njit(**JIT)(view_shape)
