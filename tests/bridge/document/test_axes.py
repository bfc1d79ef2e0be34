"""Axes of charts: their numbers stay short, and inside the drawing."""

from __future__ import annotations

import numpy as np
import pytest

from gapbridge.bridge.document.axes import distribution, plain
from gapbridge.bridge.document.drawing import INK, Text


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1e-5, "1e−5"),
        (-5e-6, "−5e−6"),
        (2e12, "2e12"),
        (0.25, "0.25"),
        (0.0, "0"),
        (1000.0, "1000"),
    ],
)
def test_a_number_has_no_zeros_that_say_nothing(value: float, text: str) -> None:
    assert plain(value) == text


@pytest.mark.parametrize("size", [1.0, 1e3, 1e-6])
def test_numbers_at_the_end_of_an_axis_are_not_cut(size: float) -> None:
    chart = distribution("gap", "mm", [("before", size * np.linspace(0.3, 9.0, 40), INK)])
    wide = 5.6  # px of a figure of 10 px, as Chromium draws it
    written = [shape for shape in chart.drawing.shapes if isinstance(shape, Text)]
    ends = [
        shape.x + wide / 2 * len(shape.text)
        for shape in written if shape.anchor == "middle" and not shape.turned
    ]  # fmt: skip
    assert len(ends) > 3
    assert max(ends) <= chart.drawing.width + 1
