"""Resampling of a recording's streams to the times of one of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.notes import Note, Reason

GAP = 5.0  # times the usual distance of two samples: beyond, nothing is interpolated


@dataclass(frozen=True)
class Stream:
    """Samples in order of time; ``columns``: arrays (N, k) by name of the log's column."""

    title: str  # the topic, for messages
    time: Array  # (N,) s
    columns: dict[str, Array]

    def in_order(self) -> Stream:
        """Return the stream sorted by time, a stamp that comes twice once."""
        time, first = np.unique(self.time, return_index=True)
        return Stream(self.title, time, {k: v[first] for k, v in self.columns.items()})

    def gaps(self) -> list[tuple[float, float]]:
        """Return begin and length (s) of stretches without samples."""
        steps = np.diff(self.time)
        if not len(steps):
            return []
        long = np.flatnonzero(steps > GAP * np.median(steps))
        return [(float(self.time[i]), float(steps[i])) for i in long]

    def at(self, time: Array) -> tuple[dict[str, Array], Mask]:
        """Return the columns interpolated to other times, and where that can be done (N,).

        Not before the first and after the last sample, nor inside of a gap. Rotation vectors
        (``measured_rotation``) go along the shortest rotation. NaN beside a missing sample.
        """
        covered = (time >= self.time[0]) & (time <= self.time[-1])
        for begin, length in self.gaps():
            covered &= ~((time > begin) & (time < begin + length))
        inside = np.clip(time, self.time[0], self.time[-1])
        found = {}
        for name, values in self.columns.items():
            if name == "measured_rotation" and len(self.time) > 1:
                from scipy.spatial.transform import Rotation, Slerp

                missing = np.isnan(values.sum(axis=1))
                kept = np.where(np.isnan(values), 0.0, values)
                turn = Slerp(self.time, Rotation.from_rotvec(kept))
                found[name] = turn(inside).as_rotvec()
                found[name][np.interp(inside, self.time, missing) > 0] = np.nan  # as a number is
            else:
                found[name] = np.column_stack(
                    [np.interp(inside, self.time, values[:, k]) for k in range(values.shape[1])]
                )
        return found, covered


def joined(base: Stream, others: list[Stream]) -> tuple[Array, dict[str, Array], list[Note]]:
    """Return times (N,), columns and notes: all streams at the times of ``base``.

    Rows that another stream does not cover are left out; what the base has already stays the
    base's.
    """
    notes = []
    covered = np.ones(len(base.time), dtype=bool)
    columns = dict(base.columns)
    for other in others:
        found, whole = other.at(base.time)
        if not whole.any():
            notes.append(Note(Reason.NO_COMMON_TIME, (other.title, base.title)))
            continue
        covered &= whole
        columns = {**found, **columns}
    for one in (base, *others):
        gaps = one.gaps()
        if gaps:
            most = max(length for _, length in gaps)
            notes.append(Note(Reason.GAPS, (one.title, len(gaps), most)))
    if not covered.all():
        notes.append(Note(Reason.UNCOVERED, (int(np.sum(~covered)), len(covered))))
    return base.time[covered], {k: v[covered] for k, v in columns.items()}, notes
