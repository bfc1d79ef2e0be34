"""What is reported of regions and sessions that were not fitted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import small_arm as small

from gapbridge.core.diagnosis.generalisation import held_out_regions


def test_regions_are_held_out_whole_without_neighbours_in_the_fit() -> None:
    observation = small.diagnosed("none").channels[0].selection.observation
    kept = np.ones(len(observation.rows), dtype=bool)
    fold, near = held_out_regions(observation, kept)
    q = np.stack([observation.quantities[f"actual_q_{i}"] for i in range(3)], axis=1)
    assert sorted(set(fold)) == [0, 1, 2, 3, 4]
    assert not near.any()
    centre = np.array([q[fold == f].mean(axis=0) for f in range(5)])
    nearest = np.argmin(np.linalg.norm(q[:, None] - centre, axis=2), axis=1)
    assert np.mean(nearest == fold) > 0.9


def test_stretches_of_a_recording_have_a_gap_to_what_is_fitted() -> None:
    observation = small.diagnosed("none").channels[0].selection.observation
    moving = replace(observation, order_in_time=True)
    count = len(observation.rows)
    fold, near = held_out_regions(moving, np.ones(count, dtype=bool))
    assert (np.diff(fold) >= 0).all()
    for f in range(5):
        judged = np.flatnonzero(fold == f)
        fitted = np.flatnonzero((fold != f) & ~near[f])
        assert min(np.abs(fitted[:, None] - judged).ravel()) >= max(0.02 * count - 1, 1)
