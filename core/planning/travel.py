"""The order of travel: how long moves take, and the shortest way through a block of poses."""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array, Index

SPEED = 0.25  # of the joints' top speed: what a technician moves with
USUAL_SPEED = 0.5  # rad/s, where the top speed is unknown
ROUNDS = 50


def joint_speed(velocity: Array) -> Array:
    """Return the speed (n,) at which joints are moved, rad/s."""
    return np.where(np.isfinite(velocity) & (velocity > 0), SPEED * velocity, USUAL_SPEED)


def leg_times(q: Array, to: Array, speed: Array) -> Array:
    """Return how long moves take from ``q`` (A, n) to ``to`` (B, n): (A, B), s."""
    return np.asarray((np.abs(q[:, None] - to[None]) / speed).max(axis=2, initial=0.0))


def in_order(q: Array, begin: Array) -> Array:
    """Return poses (N, n) in an order of short moves from ``begin`` (n,), rad."""
    speed = np.ones(q.shape[1])
    return q[shortest_way(leg_times(q, q, speed), leg_times(begin[None], q, speed)[0])]


def shortest_way(legs: Array, first: Array) -> list[int]:
    """Return an order of B stops with short legs (B, B); ``first`` (B,) leads to each from before.

    Nearest neighbour, then stretches are turned round as long as that helps (2-opt).
    """
    count = len(first)
    if count == 0:
        return []
    order = [int(np.argmin(first))]
    left = set(range(count)) - set(order)
    while left:
        nearest = min(left, key=lambda i: legs[order[-1], i])
        order.append(nearest)
        left.discard(nearest)
    for _ in range(ROUNDS):
        if not _turned_round(order, legs, first):
            break
    return order


def _turned_round(order: list[int], legs: Array, first: Array) -> bool:
    """Turn stretches of the order round where that shortens it; return whether any did."""
    better = False
    for i in range(len(order) - 1):
        for j in range(i + 1, len(order)):
            before = first[order[i]] if i == 0 else legs[order[i - 1], order[i]]
            after = first[order[j]] if i == 0 else legs[order[i - 1], order[j]]
            if j + 1 < len(order):
                before = before + legs[order[j], order[j + 1]]
                after = after + legs[order[i], order[j + 1]]
            if after < before - 1e-9:
                order[i : j + 1] = order[i : j + 1][::-1]
                better = True
    return better


def far_apart(position: Array, count: int) -> Index:
    """Return rows (count,) of positions (N, 3), m, each far from those before it."""
    chosen = [int(np.argmax(np.linalg.norm(position - position.mean(axis=0), axis=1)))]
    nearest = np.linalg.norm(position - position[chosen[0]], axis=1)
    while len(chosen) < min(count, len(position)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(position - position[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.int64)
