"""Drawings of plane shapes; svg.py and pdf.py write them.

Colours are names of PALETTE, so that a page can show them in dark mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Self

INK, SOFT, GRID, EDGE = "ink", "soft", "grid", "edge"
BEFORE, AFTER, LIMIT, BAD_DOT = "before", "after", "limit", "bad-dot"
PALE, VIOLET = "pale", "violet"
ON_BAR = "on-bar"  # text on a filled bar
PALETTE = {
    INK: "#1c2730", SOFT: "#5b6770", GRID: "#e3e8ec", EDGE: "#9aa5b1", BEFORE: "#d9822b",
    AFTER: "#1f77b4", ON_BAR: "#ffffff", LIMIT: "#2f9e62",
    BAD_DOT: "#c43d3d", PALE: "#a9cbe6", VIOLET: "#8e5bb5",
}  # fmt: skip
"""Colours of a drawing by name, on paper and on a light screen."""
DARK = {
    INK: "#e6edf3", SOFT: "#9aa9b6", GRID: "#2a3641", EDGE: "#6f7f8d", BEFORE: "#f0a35e",
    AFTER: "#6ea8ff", ON_BAR: "#0e151b", LIMIT: "#4fd093",
    BAD_DOT: "#ff7b72", PALE: "#36557a", VIOLET: "#b98be0",
}  # fmt: skip
"""The same for dark mode."""

Point = tuple[float, float]


@dataclass(frozen=True)
class Stroke:
    """Colour, width and dashes of a line."""

    colour: str = INK
    width: float = 1.0
    dashed: bool = False


@dataclass(frozen=True)
class _AtPoints:
    """A shape at several points."""

    points: tuple[Point, ...]

    def moved(self, x: float, y: float) -> Self:
        """Return the shape shifted by (x, y)."""
        return replace(self, points=tuple((a + x, b + y) for a, b in self.points))


@dataclass(frozen=True)
class Line(_AtPoints):
    """A line through points."""

    stroke: Stroke


@dataclass(frozen=True)
class _AtPoint:
    """A shape at one point."""

    x: float
    y: float

    def moved(self, x: float, y: float) -> Self:
        """Return the shape shifted by (x, y)."""
        return replace(self, x=self.x + x, y=self.y + y)


@dataclass(frozen=True)
class Rectangle(_AtPoint):
    """A filled rectangle; (x, y) is its upper left corner."""

    width: float
    height: float
    fill: str
    hint: str = ""


@dataclass(frozen=True)
class Circle(_AtPoint):
    """A filled circle."""

    radius: float
    fill: str
    opacity: float = 1.0
    hint: str = ""


@dataclass(frozen=True)
class Dots(_AtPoints):
    """Many filled circles of one size."""

    radius: float
    fill: str
    opacity: float = 1.0


@dataclass(frozen=True)
class Text(_AtPoint):
    """A line of text; ``anchor`` is start, middle or end; ``turned`` reads upwards."""

    text: str
    size: float = 11.0
    colour: str = INK
    anchor: str = "start"
    bold: bool = False
    turned: bool = False


Shape = Line | Rectangle | Circle | Dots | Text


@dataclass
class Drawing:
    """Shapes in the order in which they are drawn; x to the right, y down."""

    width: float
    height: float
    title: str  # for screen readers
    shapes: list[Shape] = field(default_factory=list)

    def line(self, points: Sequence[Point], stroke: Stroke) -> None:
        """Add a line."""
        self.shapes.append(Line(tuple(points), stroke))

    def extend(self, height: float) -> None:
        """Add ``height`` px at the bottom."""
        self.height += height

    def add(self, shape: Shape) -> None:
        """Add a shape."""
        self.shapes.append(shape)
