"""Drawings: a few shapes in a plane, which the HTML writes as SVG and the PDF as its own lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

INK, SOFT, GRID, EDGE = "#1c2730", "#5b6770", "#e3e8ec", "#9aa5b1"
BEFORE, AFTER, LIMIT, BAD_DOT = "#d9822b", "#1f77b4", "#2f9e62", "#c43d3d"

Point = tuple[float, float]


@dataclass(frozen=True)
class Stroke:
    """How a line is drawn."""

    colour: str = INK
    width: float = 1.0
    dashed: bool = False


@dataclass(frozen=True)
class Line:
    """A line through points."""

    points: tuple[Point, ...]
    stroke: Stroke


@dataclass(frozen=True)
class Rectangle:
    """A filled rectangle; (x, y) is its upper left corner."""

    x: float
    y: float
    width: float
    height: float
    fill: str
    hint: str = ""


@dataclass(frozen=True)
class Circle:
    """A circle, filled or not."""

    x: float
    y: float
    radius: float
    fill: str = ""
    stroke: Stroke | None = None
    opacity: float = 1.0
    hint: str = ""


@dataclass(frozen=True)
class Text:
    """A line of text; ``anchor`` is start, middle or end; ``turned`` reads upwards."""

    x: float
    y: float
    text: str
    size: float = 11.0
    colour: str = INK
    anchor: str = "start"
    bold: bool = False
    turned: bool = False


Shape = Line | Rectangle | Circle | Text


@dataclass
class Drawing:
    """Shapes in the order in which they are drawn; x to the right, y down."""

    width: float
    height: float
    title: str  # said to who cannot see it
    shapes: list[Shape] = field(default_factory=list)

    def line(self, points: Sequence[Point], stroke: Stroke) -> None:
        """Add a line."""
        self.shapes.append(Line(tuple(points), stroke))

    def add(self, shape: Shape) -> None:
        """Add a shape."""
        self.shapes.append(shape)
