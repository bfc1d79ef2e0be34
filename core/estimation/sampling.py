"""Fewer rows of many: one of each even stretch.

Rows at even distances would all be of one phase of what alternates from row to row, as two loads do
that are measured in turn; each is drawn at random from its stretch.
"""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Index

SEED = 0


def one_of_each_stretch(count: int, most: int, random: np.random.Generator | None = None) -> Index:
    """Return at most ``most`` of ``count`` rows, in order; without ``random`` always the same."""
    random = np.random.default_rng(SEED) if random is None else random
    ends = np.linspace(0, count, min(count, most) + 1).astype(np.int64)
    return np.asarray(random.integers(ends[:-1], ends[1:]))
