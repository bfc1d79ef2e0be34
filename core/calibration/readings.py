"""The readings of a calibration session, for any instrument."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Index
from gapbridge.core.estimation.held_out import pose_groups
from gapbridge.core.loads import Loads


@dataclass(frozen=True)
class Readings:
    """N averaged readings of one session, in the order in which they were taken.

    ``kind`` is a key of ``core.calibration.observables.OBSERVABLES``; it fixes the width k of
    ``value``: ``position`` (3, m), ``pose`` (6: m and rotation vector), ``distance`` (1, m, from a
    fixed point to the target), ``sphere`` (0: the target was brought onto a fixed sphere),
    ``relative`` (3, m: second target minus first, in the instrument's frame).
    """

    kind: str
    q: Array  # (N, n) rad, joint encoders
    value: Array  # (N, k)
    scatter: Array  # (N,) m, 1 sigma of one coordinate of the averaged reading; nan: not known
    loads: Loads
    load: Index  # (N,) number of the load in the plan, from 0; 0 is the lightest
    station: Index  # (N,) number of the instrument's place, from 0: each has a separate frame
    target: Index  # (N,) number of the ball or reflector on the tool, from 0
    held_out: NDArray[np.bool_]  # (N,) never used in a fit
    pose: Index  # (N,) number of the planned pose; repeats share one

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.q)

    def repeats(self) -> Index:
        """Return a number a reading (N,): the same pose to the same target from the same place."""
        same = np.column_stack([pose_groups(self.q), self.station, self.target])
        return np.asarray(np.unique(same, axis=0, return_inverse=True)[1].reshape(-1))

    def __getitem__(self, rows: NDArray[Any]) -> Readings:
        """Return some of the readings."""
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        return Readings(**{k: v if k == "kind" else v[rows] for k, v in given.items()})
