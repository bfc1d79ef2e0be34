"""The nuisance parameters: places of the instrument, points of its targets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.estimation.registration import IDENTITY, Registration


@dataclass(frozen=True)
class Layout:
    """Which values of a Nuisance are unknown, in the order of a step."""

    stations: int
    targets: int
    frame: tuple[int, ...]  # of the six of a frame's step
    length: bool  # one length a station
    first_target: int  # targets before it are known

    @property
    def size(self) -> int:
        """Return how many numbers are unknown (m)."""
        per_station = len(self.frame) + int(self.length)
        return self.stations * per_station + 3 * max(self.targets - self.first_target, 0)


@dataclass(frozen=True)
class Nuisance:
    """Frames of the instrument's places, points of the targets, lengths of S places."""

    stations: tuple[Registration, ...]  # measured = rotation @ position_in_base + position
    targets: Array  # (T, 3) m, TCP frame: position of each ball
    lengths: Array  # (S,) m: radius of a touched sphere, zero of a gauge

    @classmethod
    def zero(cls, stations: int = 1, targets: int = 1) -> Nuisance:
        """Return instruments with the frame of base, and targets at the TCP."""
        return cls((IDENTITY,) * stations, np.zeros((targets, 3)), np.zeros(stations))

    def frames(self, station: Index) -> tuple[Array, Array]:
        """Return rotation (N, 3, 3) and position (N, 3), m, of the places numbered (N,)."""
        rotation = np.array([place.rotation for place in self.stations]).reshape(-1, 3, 3)
        position = np.array([place.position for place in self.stations]).reshape(-1, 3)
        return rotation[station], position[station]

    def moved(self, step: Array, layout: Layout) -> Nuisance:
        """Return the nuisance after a step (m,) of its unknown values."""
        stations, targets, lengths = list(self.stations), self.targets.copy(), self.lengths.copy()
        index, frame = 0, list(layout.frame)
        for s in range(layout.stations):
            if frame:
                whole = np.zeros(6)
                whole[frame] = step[index : index + len(frame)]
                stations[s] = stations[s].moved(whole)
                index += len(frame)
            if layout.length:
                lengths[s] += step[index]
                index += 1
        for t in range(layout.first_target, layout.targets):
            targets[t] += step[index : index + 3]
            index += 3
        return Nuisance(tuple(stations), targets, lengths)
