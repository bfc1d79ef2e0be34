"""The way through the chosen stops: one place and one load after the other, short legs within."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.notes import Note, Reason
from gapbridge.core.planning.candidates import Candidates
from gapbridge.core.planning.travel import joint_speed, leg_times, shortest_way
from gapbridge.core.planning.workspace import Workspace

BETWEEN = 9  # poses looked at on a leg
ROUNDABOUT = 3.0  # times as long a leg counts on which the arm would hit something


@dataclass(frozen=True)
class Stop:
    """One visit: a candidate's row, and what for."""

    row: int
    held_out: bool = False
    repeat: int = 0


@dataclass(frozen=True)
class Itinerary:
    """The stops in the order of travel."""

    stops: tuple[Stop, ...]
    travel: float  # s
    notes: tuple[Note, ...]

    def poses(self, found: Candidates) -> tuple[PlannedPose, ...]:
        """Return the planned poses; those at the same joints share a number."""
        numbers: dict[tuple[int, int, bytes], int] = {}
        poses = []
        readings = found.readings
        approach = readings.loads.approach
        for stop in self.stops:
            row = stop.row
            side = np.zeros(found.q.shape[1]) if approach is None else approach[row]
            key = (int(readings.load[row]), int(found.stop[row]), side.tobytes())
            number = numbers.setdefault(key, len(numbers))
            poses.append(PlannedPose(
                number, readings.q[row].copy(), int(readings.load[row]), side.copy(),
                int(readings.station[row]), int(readings.target[row]), stop.held_out, stop.repeat,
            ))  # fmt: skip
        return tuple(poses)


def itinerary(
    found: Candidates, stops: Sequence[Stop], workspace: Workspace, repeats: int
) -> Itinerary:
    """Return the way through all stops and ``repeats`` second visits.

    A load's first pose is visited again at its end, which shows whether the instrument was moved.
    """
    readings = found.readings
    speed = joint_speed(workspace.model.arm.limits.velocity)
    blocks = _blocks(found, stops)
    share = _shares([sum(not stop.held_out for stop in block) for block in blocks], repeats)
    at, travel = None, 0.0
    way: list[Stop] = []
    hit: list[tuple[int, int]] = []
    for block, again in zip(blocks, share, strict=True):
        q = readings.q[[stop.row for stop in block]]
        legs, blocked = _legs(q, workspace, speed)
        first = np.zeros(len(q)) if at is None else leg_times(at[None], q, speed)[0]
        order = shortest_way(np.where(blocked, ROUNDABOUT * legs + 1.0, legs), first)
        own = [block[i] for i in order]
        fitted = [i for i in order if not block[i].held_out]
        order += [fitted[i] for i in _spread(len(fitted), again)]
        for step, (a, b) in enumerate(pairwise(order)):
            travel += float(legs[a, b])
            if blocked[a, b]:
                hit.append((len(way) + step, len(way) + step + 1))
        travel += float(first[order[0]])
        way += own + [replace(block[i], repeat=1) for i in order[len(own) :]]
        at = q[order[-1]]
    ways = tuple((a + 1, b + 1) for a, b in hit)
    return Itinerary(tuple(way), travel, (Note(Reason.DETOURS, (ways,)),) if ways else ())


def _shares(fitted: list[int], repeats: int) -> list[int]:
    """Return how many fitted stops of each block are visited again, the blocks in turn."""
    share = [0] * len(fitted)
    for _ in range(min(repeats, sum(fitted))):
        block = min((b for b in range(len(share)) if share[b] < fitted[b]), key=lambda b: share[b])
        share[block] += 1
    return share


def _spread(count: int, again: int) -> list[int]:
    """Return which stops of a block are visited again: the first, then evenly through it."""
    step = count / max(again, 1)
    return [int(i * step) for i in range(min(again, count))]


def _blocks(found: Candidates, stops: Sequence[Stop]) -> list[list[Stop]]:
    """Return the stops by place, then load; the loads turn round from place to place."""
    readings = found.readings
    groups: dict[tuple[int, int], list[Stop]] = {}
    for stop in stops:
        key = (int(readings.station[stop.row]), int(readings.load[stop.row]))
        groups.setdefault(key, []).append(stop)

    def turn(key: tuple[int, int]) -> tuple[int, int]:
        station, load = key
        return station, load if station % 2 == 0 else -load

    return [groups[key] for key in sorted(groups, key=turn)]


def _legs(q: Array, workspace: Workspace, speed: Array) -> tuple[Array, Mask]:
    """Return the times (B, B) between poses, and where the straight way hits something."""
    count = len(q)
    legs = leg_times(q, q, speed)
    blocked = np.zeros((count, count), dtype=bool)
    one, other = np.triu_indices(count, 1)
    if len(one):
        share = np.linspace(0, 1, BETWEEN + 2)[1:-1]
        between = q[one][:, None] + share[:, None] * (q[other] - q[one])[:, None]
        clear = workspace.clear(between.reshape(-1, q.shape[1])).reshape(-1, BETWEEN)
        blocked[one, other] = blocked[other, one] = ~clear.all(axis=1)
    return legs, blocked
