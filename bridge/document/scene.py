"""A 3-D scene of lines and arrows, shown interactively in HTML and projected in PDF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gapbridge.bridge.document.drawing import GRID, INK, SOFT, Drawing, Stroke, Text
from gapbridge.bridge.document.drawing import Circle as Ring
from gapbridge.core.arrays import Array

AZIMUTH, ELEVATION = -0.9, 0.42  # rad, initial view
WIDTH, HEIGHT = 640.0, 430.0
MARGIN = 22.0


@dataclass(frozen=True)
class Path:
    """A line through points (k, 3), m; ``dots``: with a ring at each."""

    points: Array
    colour: str
    width: float = 1.0
    dots: bool = False


@dataclass(frozen=True)
class Arrows:
    """Arrows from points (m, 3) to points (m, 3), m."""

    start: Array
    end: Array
    colour: str


@dataclass(frozen=True)
class Scene:
    """Lines and arrows (m) in one frame with z up, and a legend of (text, colour)."""

    title: str
    paths: tuple[Path, ...]
    arrows: tuple[Arrows, ...] = ()
    legend: tuple[tuple[str, str], ...] = ()

    def document(self) -> dict[str, Any]:
        """Return the scene as JSON values, coordinates rounded to 0.1 mm."""
        return {
            "title": self.title,
            "view": [AZIMUTH, ELEVATION],
            "paths": [
                {"points": _plain(p.points), "colour": p.colour, "width": p.width, "dots": p.dots}
                for p in self.paths
            ],
            "arrows": [
                {"start": _plain(a.start), "end": _plain(a.end), "colour": a.colour}
                for a in self.arrows
            ],
            "legend": [list(entry) for entry in self.legend],
        }

    def drawing(self) -> Drawing:
        """Return the initial view as a drawing."""
        drawing = Drawing(WIDTH, HEIGHT, self.title)
        every = [p.points for p in self.paths] + [x for a in self.arrows for x in (a.start, a.end)]
        flat = _projected(np.vstack(every))
        low, high = flat.min(axis=0), flat.max(axis=0)
        room = np.array([WIDTH, HEIGHT]) - 2 * MARGIN
        scale = float(np.min(room / np.maximum(high - low, 1e-9)))
        middle = (low + high) / 2

        def to_drawing(points: Array) -> list[tuple[float, float]]:
            flat = (_projected(points) - middle) * scale
            return [(WIDTH / 2 + float(x), HEIGHT / 2 - float(y)) for x, y in flat]

        for path in self.paths:
            places = to_drawing(path.points)
            drawing.line(places, Stroke(path.colour, path.width))
            if path.dots:
                for place in places:
                    drawing.add(Ring(*place, path.width / 2 + 0.6, path.colour))
        for arrows in self.arrows:
            for start, end in zip(to_drawing(arrows.start), to_drawing(arrows.end), strict=True):
                drawing.line([start, end], Stroke(arrows.colour, 1.1))
                drawing.add(Ring(*end, 1.5, arrows.colour))
        x = 6.0
        for text, colour in self.legend:
            drawing.add(Ring(x + 4, 10, 3.6, colour))
            drawing.add(Text(x + 12, 13.5, text, 10.5, SOFT))
            x += 24 + 5.8 * len(text)
        return drawing


def base(reach: float) -> tuple[Path, ...]:
    """Return a floor grid (z = 0) and a marker at the base, for an arm of this reach, m."""
    step = 0.1 if reach < 0.7 else 0.25
    count = max(int(np.ceil(0.5 * reach / step)), 2)
    side = np.arange(-count, count + 1) * step
    edge = count * step
    lines = [np.array([[x, -edge, 0.0], [x, edge, 0.0]]) for x in side]
    lines += [np.array([[-edge, y, 0.0], [edge, y, 0.0]]) for y in side]
    grid = tuple(Path(line, GRID, 0.7) for line in lines)
    upright = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return (*grid, Path(upright, INK, 9.0, dots=True))


def _projected(points: Array) -> Array:
    """Return points (N, 3) in the plane of the picture (N, 2): right and up."""
    return np.asarray(points) @ _axes().T


def _axes() -> Array:
    ca, sa, ce, se = np.cos(AZIMUTH), np.sin(AZIMUTH), np.cos(ELEVATION), np.sin(ELEVATION)
    return np.array([[ca, sa, 0.0], [-sa * se, ca * se, ce]])


def _plain(points: Array | Sequence[Sequence[float]]) -> list[list[float]]:
    return np.round(np.asarray(points), 4).tolist()  # type: ignore[no-any-return]
