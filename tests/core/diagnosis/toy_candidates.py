"""Sample spaces made of random columns: what is true of them is known without any arm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.sample_space import SampleSpace, penalties
from gapbridge.core.effects import Parameter, Site


def named(family: str, size: int = 1, joint: int | None = None, lower: float = -np.inf, order=None):
    """Return a named candidate of unit scale."""
    parameters = (Parameter("", "", 1.0, lower),) * size
    return Candidate(family, Site(joint, order), parameters, (None,) * size)


def smooth(quantity: str, target: str = "position", size: int = 1):
    """Return an unnamed function of a quantity."""
    parameters = (Parameter("", "", 1.0),) * size
    return Candidate("smooth", Site(), parameters, (None,) * size, quantity=quantity, target=target)


def space_of(candidates: Sequence[Candidate], y, X) -> SampleSpace:
    """Return the space of these candidates, noise of unit size."""
    size = np.array([len(c.parameters) for c in candidates])
    start = np.concatenate([[0], np.cumsum(size)])
    assert X.shape == (len(y), start[-1])
    return SampleSpace(
        y, X, start, tuple(candidates), penalties(candidates, float(len(y))), float(len(y)), 1e-6
    )


def random_space(seed: int, candidates: Sequence[Candidate], rows: int = 90, planted=(), size=3.0):
    """Return a space of random columns in which ``planted`` candidates act."""
    rng = np.random.default_rng(seed)
    width = sum(len(c.parameters) for c in candidates)
    X = rng.normal(size=(rows, width))
    space = space_of(candidates, np.zeros(rows), X)
    y = rng.normal(size=rows)
    for c in planted:
        block = space.columns([c])
        y = y + block @ np.full(block.shape[1], size)
    return space_of(candidates, y, X)
