"""Fewer samples of a channel, for the search: one of each even stretch of every session."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gapbridge.core.arrays import Index
from gapbridge.core.diagnosis.observation import NotObservable, Observation
from gapbridge.core.estimation.sampling import SEED, one_of_each_stretch
from gapbridge.core.log.log import Log


def drawn(session: Index, most: int) -> Index:
    """Return at most ``most`` of the rows of sessions (N,), in order; all of a small session.

    Sessions that have to be thinned get the same number of rows, one of each even stretch.
    """
    if len(session) <= most:
        return np.arange(len(session))
    rng = np.random.default_rng(SEED)
    rows = [np.flatnonzero(session == s) for s in np.unique(session)]
    taken, left = [], most
    for i, own in enumerate(sorted(rows, key=len)):
        count = min(len(own), left // (len(rows) - i))
        taken.append(own[one_of_each_stretch(len(own), count, rng)])
        left -= count
    return np.sort(np.concatenate(taken))


def thinned(observation: Observation, most: int) -> Observation:
    """Return a channel of a recording with at most ``most`` samples.

    Predictions are still made on the full log, for delays and derivatives.
    """
    assert observation.subset is not None
    return observation.subset(drawn(_sessions(observation), most))


def thinned_poses(
    observation: Observation, log: Log, observe: Callable[[Log], Observation | NotObservable],
    most: int,
) -> Observation:  # fmt: skip
    """Return the position channel of ``log`` with at most ``most`` poses, observed again.

    Their frames are then free.
    """
    few = drawn(_sessions(observation), most)
    rows = observation.rows[few]
    # approach directions come from neighbouring rows: derived before rows are left out
    approach = log.approach()
    columns = dict(log.columns) | ({} if approach is None else {"approach": approach})
    part = observe(replace(log, columns=columns).select(rows))
    assert isinstance(part, Observation)
    if not observation.order_in_time:
        return replace(part, rows=rows)
    return replace(
        part, rows=rows, groups=observation.groups[few], order_in_time=True,
        instrument=observation.instrument,
    )  # fmt: skip


def _sessions(observation: Observation) -> Index:
    """Return the session (N,) of each sample; zeros where there is one."""
    if observation.session is None:
        return np.zeros(len(observation.rows), dtype=np.int64)
    return observation.session
