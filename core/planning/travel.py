"""Travel times of joint moves, and short orders of poses."""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array, Index

SPEED_SHARE = 0.25  # of the joints' top speed: a usual manual speed
DEFAULT_SPEED = 0.5  # rad/s, where the top speed is unknown
MAX_PASSES = 50


def joint_speed(velocity: Array) -> Array:
    """Return the speed (n,) at which joints are moved, rad/s."""
    return np.where(np.isfinite(velocity) & (velocity > 0), SPEED_SHARE * velocity, DEFAULT_SPEED)


def move_times(q: Array, target: Array, speed: Array) -> Array:
    """Return how long moves take from ``q`` (A, n) to ``target`` (B, n): (A, B), s."""
    return np.asarray((np.abs(q[:, None] - target[None]) / speed).max(axis=2, initial=0.0))


def ordered_poses(q: Array, begin: Array) -> Array:
    """Return poses (N, n) in an order of short moves from ``begin`` (n,), rad."""
    speed = np.ones(q.shape[1])
    return q[shortest_order(move_times(q, q, speed), move_times(begin[None], q, speed)[0])]


def shortest_order(times: Array, first: Array) -> list[int]:
    """Return an order of B stops with short legs (B, B); ``first`` (B,) leads to each from before.

    Nearest neighbour, improved by 2-opt.
    """
    count = len(first)
    if count == 0:
        return []
    order = [int(np.argmin(first))]
    remaining = set(range(count)) - set(order)
    while remaining:
        nearest = min(remaining, key=lambda i: times[order[-1], i])
        order.append(nearest)
        remaining.discard(nearest)
    for _ in range(MAX_PASSES):
        if not _two_opt_pass(order, times, first):
            break
    return order


def _two_opt_pass(order: list[int], times: Array, first: Array) -> bool:
    """Reverse segments of the order where that shortens it; return whether any did."""
    improved = False
    for i in range(len(order) - 1):
        for j in range(i + 1, len(order)):
            before = first[order[i]] if i == 0 else times[order[i - 1], order[i]]
            after = first[order[j]] if i == 0 else times[order[i - 1], order[j]]
            if j + 1 < len(order):
                before = before + times[order[j], order[j + 1]]
                after = after + times[order[i], order[j + 1]]
            if after < before - 1e-9:
                order[i : j + 1] = order[i : j + 1][::-1]
                improved = True
    return improved


def spread_rows(position: Array, count: int) -> Index:
    """Return rows (count,) of positions (N, 3), m, each far from those before it."""
    chosen = [int(np.argmax(np.linalg.norm(position - position.mean(axis=0), axis=1)))]
    nearest = np.linalg.norm(position - position[chosen[0]], axis=1)
    while len(chosen) < min(count, len(position)):
        chosen.append(int(np.argmax(nearest)))
        nearest = np.minimum(nearest, np.linalg.norm(position - position[chosen[-1]], axis=1))
    return np.array(chosen, dtype=np.int64)
