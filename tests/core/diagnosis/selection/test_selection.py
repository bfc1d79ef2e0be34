"""The terms of a search, refitted without the others."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import small_arm as small

from gapbridge.core.diagnosis.selection import selection as selections
from gapbridge.core.diagnosis.selection.refit import UnnamedPart
from gapbridge.core.diagnosis.selection.selection import Selection, refitted_alone


@pytest.fixture(scope="module")
def found() -> Selection:
    return small.diagnosed("joint_offset").channels[0].selection


@pytest.mark.parametrize(("excess", "counts"), [(1.9, True), (2.1, False)])
def test_values_of_a_direction_that_unnamed_functions_absorb_do_not_count(
    found: Selection, monkeypatch: pytest.MonkeyPatch, excess: float, counts: bool
) -> None:
    """An iiwa's tool ran off by 11 mm, which they absorbed: by itself it left 25 times as much."""

    def refit(state: Any, *arguments: Any) -> Any:
        part: UnnamedPart = arguments[3]
        left = excess if part.columns.shape[1] else 1.0
        residual = np.full(found.residual.shape, left)
        return state, found.terms, found.term_index, found.covariance, residual

    monkeypatch.setattr(selections, "refit", refit)
    rows = len(found.space.y)
    part = UnnamedPart(np.ones((rows, 1)), np.array([np.inf]), np.arange(rows) % 8)
    accused = range(len(found.terms))
    again = refitted_alone(found, small.model_of().arm, accused, part)
    assert again.residual[0, 0] == (excess if counts else 1.0)
