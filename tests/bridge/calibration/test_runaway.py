"""A fit with larger errors on held-out poses is never written."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.jobs.calibrate import worse_than_before
from gapbridge.core.calibration.result import Errors


def errors(size: float, count: int = 4) -> Errors:
    return Errors(np.full((count, 3), size), np.arange(count))


def test_a_fit_that_is_worse_on_unseen_poses_is_refused_with_both_figures() -> None:
    reason = worse_than_before(errors(1e-3), errors(2e-2))
    assert reason is not None
    assert "from 1.732 to 34.641 mm rms: nothing is applied" in reason


def test_a_better_fit_is_not_refused_nor_one_without_held_out_poses() -> None:
    assert worse_than_before(errors(1e-3), errors(1e-4)) is None
    assert worse_than_before(errors(0, 0), errors(0, 0)) is None
