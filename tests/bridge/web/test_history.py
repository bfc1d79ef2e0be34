"""The curves of the page, thinned to as many points as are asked for."""

from __future__ import annotations

import numpy as np
import pytest

from gapbridge.bridge.web.page_data import COLUMNS, STEP, History


@pytest.mark.parametrize(("seconds", "most"), [(30.0, 100), (10.0, 3), (5.0, 50), (60.0, 1)])
def test_a_history_holds_no_more_points_than_asked_for(seconds: float, most: int) -> None:
    history = History(60.0)
    cycles = np.zeros((8000, len(COLUMNS)))
    cycles[:, 0] = 1000.0 + 0.008 * np.arange(len(cycles))
    history.add(cycles, 1064.0)
    points = history.since(seconds, most)
    assert len(points) == most
    assert (np.diff(points[:, 0]) > 0).all()
    assert points[-1, 0] == pytest.approx(1064.0, abs=2 * STEP)


def test_a_clock_that_is_set_back_leaves_no_points_in_the_future() -> None:
    history, elapsed = History(600.0), 0.0
    for span, clock in ((400.0, 1e9), (200.0, 1e9 - 7200.0)):
        until = elapsed + span
        while elapsed < until:
            elapsed += 0.1
            cycles = np.zeros((10, len(COLUMNS)))
            cycles[:, 0] = clock + elapsed - 0.1 + 0.01 * np.arange(10)
            history.add(cycles, clock + elapsed)
    points = history.since(600.0, 2000)
    assert (np.diff(points[:, 0]) > 0).all()
    assert points[-1, 0] == pytest.approx(1e9 - 7200.0 + elapsed, abs=2 * STEP)
    assert len(history._pending) < 10
