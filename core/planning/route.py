"""The order of the visits: grouped by place and load, short moves within each group."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.notes import Note, Reason
from gapbridge.core.planning.candidates import Candidates
from gapbridge.core.planning.travel import joint_speed, move_times, shortest_order
from gapbridge.core.planning.workspace import Workspace

CHECKS_PER_LEG = 9  # intermediate poses checked for collision on a leg
COLLISION_FACTOR = 3.0  # factor on the cost of a leg with a collision


@dataclass(frozen=True)
class Visit:
    """One visit: a candidate's row, and its purpose."""

    row: int
    held_out: bool = False
    repeat: int = 0


@dataclass(frozen=True)
class Route:
    """The stops in the order of travel."""

    stops: tuple[Visit, ...]
    travel: float  # s
    notes: tuple[Note, ...]

    def poses(self, candidates: Candidates) -> tuple[PlannedPose, ...]:
        """Return the planned poses; those at the same joints share a number."""
        numbers: dict[tuple[int, int, bytes], int] = {}
        poses = []
        readings = candidates.readings
        approach = readings.loads.approach
        for stop in self.stops:
            row = stop.row
            side = np.zeros(candidates.q.shape[1]) if approach is None else approach[row]
            key = (int(readings.load[row]), int(candidates.stop[row]), side.tobytes())
            number = numbers.setdefault(key, len(numbers))
            poses.append(PlannedPose(
                number, readings.q[row].copy(), int(readings.load[row]), side.copy(),
                int(readings.station[row]), int(readings.target[row]), stop.held_out, stop.repeat,
            ))  # fmt: skip
        return tuple(poses)


def plan_route(
    candidates: Candidates, stops: Sequence[Visit], workspace: Workspace, repeats: int
) -> Route:
    """Return the route through all stops and ``repeats`` second visits.

    The first pose of a load is repeated at its end, to detect an instrument that has moved.
    """
    readings = candidates.readings
    speed = joint_speed(workspace.model.arm.limits.velocity)
    blocks = _blocks(candidates, stops)
    counts = _repeats_per_block(
        [sum(not stop.held_out for stop in block) for block in blocks], repeats
    )
    previous: Array | None = None
    travel = 0.0
    ordered: list[Visit] = []
    detours: list[tuple[int, int]] = []  # stops from 1
    for block, repeated in zip(blocks, counts, strict=True):
        count, q = len(block), readings.q[[stop.row for stop in block]]
        # the last stop before the block is the last row
        known = q if previous is None else np.vstack([q, previous])
        legs, blocked = _legs_between(known, workspace, speed)
        cost = np.where(blocked, COLLISION_FACTOR * legs + 1.0, legs)
        first = np.zeros(count) if previous is None else cost[count, :count]
        order = shortest_order(cost[:count, :count], first)
        visits = [block[i] for i in order]
        fitted = [i for i in order if not block[i].held_out]
        order += [fitted[i] for i in _repeat_indices(len(fitted), repeated)]
        begin = [] if previous is None else [count]
        for stop, (a, b) in enumerate(pairwise(begin + order), len(ordered) + 1 - len(begin)):
            travel += float(legs[a, b])
            if blocked[a, b]:
                detours.append((stop, stop + 1))
        ordered += visits + [replace(block[i], repeat=1) for i in order[count:]]
        previous = q[order[-1]]
    notes = (Note(Reason.DETOURS, (tuple(detours),)),) if detours else ()
    return Route(tuple(ordered), travel, notes)


def _repeats_per_block(fitted: list[int], repeats: int) -> list[int]:
    """Return how many fitted stops of each block are repeated, distributed evenly."""
    counts = [0] * len(fitted)
    for _ in range(min(repeats, sum(fitted))):
        block = min(
            (b for b in range(len(counts)) if counts[b] < fitted[b]), key=lambda b: counts[b]
        )
        counts[block] += 1
    return counts


def _repeat_indices(count: int, repeated: int) -> list[int]:
    """Return which stops of a block are repeated: the first, then evenly spaced ones."""
    step = count / max(repeated, 1)
    return [int(i * step) for i in range(min(repeated, count))]


def _blocks(candidates: Candidates, stops: Sequence[Visit]) -> list[list[Visit]]:
    """Return the stops by place, then load; the order of loads alternates between places."""
    readings = candidates.readings
    groups: dict[tuple[int, int], list[Visit]] = {}
    for stop in stops:
        key = (int(readings.station[stop.row]), int(readings.load[stop.row]))
        groups.setdefault(key, []).append(stop)

    def block_order(key: tuple[int, int]) -> tuple[int, int]:
        station, load = key
        return station, load if station % 2 == 0 else -load

    return [groups[key] for key in sorted(groups, key=block_order)]


def _legs_between(q: Array, workspace: Workspace, speed: Array) -> tuple[Array, Mask]:
    """Return the times (B, B), s, between poses, and which straight joint moves collide."""
    count = len(q)
    legs = move_times(q, q, speed)
    blocked = np.zeros((count, count), dtype=bool)
    one, other = np.triu_indices(count, 1)
    if len(one):
        share = np.linspace(0, 1, CHECKS_PER_LEG + 2)[1:-1]
        between = q[one][:, None] + share[:, None] * (q[other] - q[one])[:, None]
        clear = workspace.clear(between.reshape(-1, q.shape[1])).reshape(-1, CHECKS_PER_LEG)
        blocked[one, other] = blocked[other, one] = ~clear.all(axis=1)
    return legs, blocked
