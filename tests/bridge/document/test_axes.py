"""Axes of charts: tick labels are short and inside the drawing."""

from __future__ import annotations

import numpy as np
import pytest

from gapbridge.bridge.document.axes import Chart, distribution, scale
from gapbridge.bridge.document.drawing import INK, Text
from gapbridge.bridge.document.numbers import plain


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


def drawn(text: str) -> float:
    """Return the px of a number of 10 px in DejaVu Sans, as Chromium measures it."""
    return sum({"−": 8.38, "e": 6.15, ".": 3.18}.get(letter, 6.36) for letter in text)


@pytest.mark.parametrize("size", [1.0, 1e3, 1e-6])
def test_numbers_at_the_end_of_an_axis_are_not_cut(size: float) -> None:
    chart = distribution("gap", "mm", [("before", size * np.linspace(0.3, 9.0, 40), INK)])
    written = [shape for shape in chart.drawing.shapes if isinstance(shape, Text)]
    ends = [
        shape.x + drawn(shape.text) / 2
        for shape in written if shape.anchor == "middle" and not shape.turned
    ]  # fmt: skip
    assert len(ends) > 3
    assert max(ends) <= chart.drawing.width + 1


@pytest.mark.parametrize("most", [1.0, 0.1, -0.025, 8e-6])
def test_numbers_stand_beside_the_title_of_the_upright_axis(most: float) -> None:
    chart = Chart("poses", scale("row", [0, 30]), scale("1 sigma, mm", [0.0, most]))
    written = [shape for shape in chart.drawing.shapes if isinstance(shape, Text)]
    title = next(shape for shape in written if shape.turned)
    begins = [shape.x - drawn(shape.text) for shape in written if shape.anchor == "end"]
    assert len(begins) > 3
    assert min(begins) > title.x + title.size / 3  # what hangs below the line of text
