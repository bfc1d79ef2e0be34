"""What a pose can depend on, number by number: the slots of its derivatives, and who fills them.

A parameter of a model moves some of these numbers; its column is the sum of their slots, each times
its rate. Slots of an arm of n joints, in this order: links (position and turn of the next joint's
frame, in the axes of the link before), tool, compliances, softening, gravity, the base's compliance
(those hold for all rows); joint angles, link scales, payload mass (those differ from row to row).
"""

from __future__ import annotations

from typing import NamedTuple

from numba import njit

from gapbridge.core.arrays import Array
from gapbridge.core.kernels.reference import JIT


class ChainRate(NamedTuple):
    """How a chain changes with one parameter, per unit of it: views of one vector of slots."""

    link: Array  # (n+1, 6): m of Chain.position, rad of Chain.rotation turned from the left
    tool: Array  # (6,): m of Chain.tool_position, rad of Chain.tool_rotation from the left
    compliance: Array  # (n, 3)
    softening: Array  # (n,)
    gravity: Array  # (3,)
    base_compliance: Array  # (3,)


@njit(inline="always", **JIT)
def of_rows(n):  # type: ignore[no-untyped-def]
    """Return the first slot that differs from row to row: n angles, n link scales, a mass."""
    return 10 * n + 18


@njit(inline="always", **JIT)
def slots(n):  # type: ignore[no-untyped-def]
    """Return how many slots there are."""
    return 12 * n + 19


def chain_rate(n: int, vector: Array) -> ChainRate:
    """Return views of a vector of slots (``slots(n)``,), for a member of the catalogue to fill."""
    tool = 6 * (n + 1)
    give = tool + 6
    soft = give + 3 * n
    gravity = soft + n
    return ChainRate(
        vector[:tool].reshape(n + 1, 6), vector[tool:give], vector[give:soft].reshape(n, 3),
        vector[soft:gravity], vector[gravity : gravity + 3], vector[gravity + 3 : gravity + 6],
    )  # fmt: skip
