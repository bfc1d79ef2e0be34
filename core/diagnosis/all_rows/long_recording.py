"""Recordings too long for memory: an excerpt for the search, and blocks for the validation.

Blocks are consecutive. Each has the preceding rows that delays need, and derivatives computed with
the neighbouring rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from gapbridge.core.arrays import Index
from gapbridge.core.log.log import Log
from gapbridge.core.motion import EDGE, LEAD, check_order, is_moving, motion_of, with_motion

WHOLE = 30_000  # rows up to which a recording is processed at once
EXCERPT = 20_000  # rows of an excerpt
WINDOW, FEWEST = 1.0, 500  # s and rows of each window of an excerpt, at least
WINDOWS = 12  # at least
DERIVED = 32_768  # rows whose derivatives are computed at a time
BLOCK = 4096  # rows of a block, for the processor's cache
BLOCKS = 120  # at least, because conditions and regions consist of blocks


@dataclass(frozen=True)
class Block:
    """Rows ``begin`` to ``end`` of a recording, with the preceding ones that they need."""

    log: Log  # of rows ``first`` to ``end``
    first: int
    begin: int
    end: int


@dataclass(frozen=True)
class LongRecording:
    """A recording that is searched in an excerpt and validated block by block."""

    log: Log
    excerpt: Log  # windows of neighbouring rows, evenly spread
    rows: Index  # (E,) row in the log of each row of the excerpt
    step: float  # s between rows

    def __iter__(self) -> Iterator[Block]:
        """Yield the blocks in order, each within one session."""
        start, still = float(self.log.columns["timestamp"][0]), motion_of(self.excerpt).still
        lead = min(int(np.ceil(LEAD / self.step)), BLOCK)
        for ends in self._groups():
            low = max(ends[0] - lead - EDGE, 0)
            part = self.log.select(slice(low, min(ends[-1] + EDGE, len(self.log))))
            motion = replace(motion_of(part), start=start, still=still)
            for begin, end in pairwise(ends):
                first = max(begin - lead, low)
                own = motion.pick((motion.rows >= first - low) & (motion.rows < end - low))
                own = replace(own, rows=own.rows - (first - low))
                rows = part.select(slice(first - low, end - low))
                yield Block(with_motion(rows, own), first, begin, end)

    def _groups(self) -> Iterator[list[int]]:
        """Yield the limits of neighbouring blocks whose derivatives are computed together."""
        count = len(self.log)
        session = self.log.columns["session"] if self.log.session_names else np.zeros(1)
        changes = [int(c) + 1 for c in np.flatnonzero(np.diff(session))]
        size = min(BLOCK, -(-count // BLOCKS))
        for begin, end in pairwise([0, *changes, count]):
            blocks = -(-(end - begin) // size)
            ends = [int(e) for e in np.linspace(begin, end, blocks + 1)]
            at_once = max(DERIVED // size, 1)
            for k in range(0, blocks, at_once):
                yield ends[k : k + at_once + 1]


def long_recording(log: Log) -> LongRecording | None:
    """Return a recording that is too long to be processed at once; None: it is not.

    Raises LogError if a time or an angle is not finite, or time decreases.
    """
    if len(log) <= WHOLE or not log.has("timestamp"):
        return None
    if not (log.has("actual_q") or log.has("target_q")):
        return None
    time, q = log.require("timestamp"), log.require("actual_q", "target_q")
    step = float(np.median(np.diff(time)))
    if not step > 0:
        return None
    rows = _windows(len(log), max(FEWEST, int(WINDOW / step)))
    excerpt = log.select(rows)
    if not is_moving(time[rows], q[rows], excerpt.get("actual_qd")):
        return None
    check_order(log, time)
    return LongRecording(log, excerpt, rows, step)


def _windows(count: int, width: int) -> Index:
    """Return the rows of windows of ``width`` rows, evenly spread over ``count``."""
    windows = max(EXCERPT // width, WINDOWS)
    begins = np.linspace(0, max(count - width, 0), windows).astype(np.int64)
    rows = np.unique(begins[:, None] + np.arange(width))
    return rows[rows < count]
