"""Charts: axes with scales and ticks, and the marks drawn in them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from gapbridge.bridge.document.drawing import (
    EDGE,
    GRID,
    INK,
    SOFT,
    Circle,
    Dots,
    Drawing,
    Line,
    Point,
    Rectangle,
    Stroke,
    Text,
)
from gapbridge.bridge.document.numbers import DIGITS, plain
from gapbridge.core.arrays import Array

WIDTH, HEIGHT = 340.0, 230.0
LEFT, RIGHT, TOP, BOTTOM = 44.0, 10.0, 30.0, 38.0
TITLE = 20.0  # px of the y axis' title and its margin
DIGIT, MINUS = 6.4, 8.4  # px, width of a digit and a minus sign of 10 px in the widest usual font
MARGIN = 0.04  # of the values, beyond them on a tight axis
MOST_DIGITS = 17  # that distinguish all numbers


def tick_labels(ticks: Sequence[float]) -> tuple[str, ...]:
    """Return the ticks as numbers with as many digits as their distance needs."""
    gaps = [abs(b - a) for a, b in pairwise(ticks)]
    exact = 1e-3 * min(gaps, default=math.inf)
    digits = DIGITS
    while digits < MOST_DIGITS and any(
        abs(float(f"{tick:.{digits}g}") - tick) > exact for tick in ticks
    ):
        digits += 1
    return tuple(plain(tick, digits) for tick in ticks)


def _width(text: str) -> float:
    """Return the largest width, px, of a number in 10 px type."""
    return DIGIT * len(text) + (MINUS - DIGIT) * text.count("−")


@dataclass(frozen=True)
class Scale:
    """One axis: title, range and ticks."""

    title: str
    low: float
    high: float
    ticks: tuple[float, ...] = ()  # none: no grid
    labels: tuple[str, ...] = ()  # of the ticks, instead of their numbers
    log: bool = False
    grid: bool = True

    @property
    def texts(self) -> tuple[str, ...]:
        """Return the text of each tick."""
        return self.labels or tick_labels(self.ticks)

    def share(self, value: float) -> float:
        """Return the position of a value on the axis, 0 to 1."""
        if self.log:
            low, high = math.log10(self.low), math.log10(self.high)
            value = math.log10(max(value, self.low))
            return (value - low) / (high - low)
        return (value - self.low) / (self.high - self.low)


def scale(
    title: str, values: Sequence[float], *, tight: bool = False, ticks: int = 4, zero: bool = True
) -> Scale:
    """Return a scale with round ticks that covers all values, and 0 where ``zero``.

    It begins and ends at a tick; where ``tight``, 4 % beyond the values.
    """
    finite = [float(v) for v in values if math.isfinite(v)] or [0.0]
    low, high = min(finite), max(finite)
    if zero:
        low, high = min(low, 0.0), max(high, 0.0)
    size = max(abs(low), abs(high))
    if high - low < 1e-12 * max(size, 1.0):
        high = low + max(1.0, 1e-6 * size)
    step = _round_step((high - low) / ticks)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    places = tuple(k * step for k in range(first, last + 1))
    if tight:
        low, high = low - MARGIN * (high - low), high + MARGIN * (high - low)
        return Scale(title, low, high, tuple(v for v in places if low <= v <= high))
    return Scale(title, places[0], places[-1], places)


def logarithmic(title: str, values: Sequence[float]) -> Scale:
    """Return a logarithmic scale that covers all values above 0."""
    positive = [float(v) for v in values if math.isfinite(v) and v > 0] or [1.0]
    steps = (1.0, 2.0, 5.0)
    first = math.floor(math.log10(min(positive)))
    last = math.ceil(math.log10(max(positive)))
    every = [k * 10.0**e for e in range(first, last + 1) for k in steps]
    low = max(v for v in every if v <= min(positive) * (1 + 1e-9))
    high = min((v for v in every if v >= max(positive) and v > low), default=2 * low)
    ticks = tuple(v for v in every if low <= v <= high)
    if len(ticks) > 7:
        ticks = tuple(v for v in ticks if abs(math.log10(v) % 1) < 1e-9)
    return Scale(title, low, high, ticks, log=True)


def visible(values: Sequence[float]) -> list[float]:
    """Return values for a logarithmic scale, at least a twentieth of their lower quartile."""
    least = sorted(values)[len(values) // 4] / 20 if values else 0.0
    return [max(v, least) for v in values]


def named(title: str, labels: Sequence[str]) -> Scale:
    """Return a scale of categories at 0, 1, 2, ..."""
    count = len(labels)
    return Scale(title, -0.5, count - 0.5, tuple(float(i) for i in range(count)), tuple(labels),
                 grid=False)  # fmt: skip


def _round_step(rough: float) -> float:
    size = 10.0 ** math.floor(math.log10(rough))
    return next(size * k for k in (1.0, 2.0, 2.5, 5.0, 10.0) if size * k >= rough * (1 - 1e-9))


class Chart:
    """A drawing with axes."""

    def __init__(
        self, title: str, x: Scale, y: Scale, *, height: float = HEIGHT, left: float = LEFT,
        width: float = WIDTH, equal: bool = False,
    ) -> None:  # fmt: skip
        self.x, self.y = x, y
        widest = max(map(_width, [] if y.labels else y.texts), default=0.0)
        self.left, self.top = max(left, TITLE + widest), TOP
        self.right, self.bottom = width - RIGHT, height - BOTTOM
        if equal:
            self._make_equal()
        self.drawing = Drawing(width, height, title)
        self.drawing.add(Text(0, 13, title, 12, INK, bold=True))
        self._axes()

    def at(self, x: float, y: float) -> Point:
        """Return the place of a value in the drawing, px."""
        return (
            self.left + self.x.share(x) * (self.right - self.left),
            self.bottom - self.y.share(y) * (self.bottom - self.top),
        )

    def points(
        self, x: Sequence[float], y: Sequence[float], colour: str, *, radius: float = 2.6,
        opacity: float = 0.75, hints: Sequence[str] = (),
    ) -> None:  # fmt: skip
        """Draw a dot for each value."""
        places = tuple(self.at(float(a), float(b)) for a, b in zip(x, y, strict=True))
        if not hints:
            self.drawing.add(Dots(places, radius, colour, opacity))
        for place, hint in zip(places, hints, strict=False):
            self.drawing.add(Circle(*place, radius, colour, opacity=opacity, hint=hint))

    def line(
        self, x: Sequence[float], y: Sequence[float], colour: str, *, width: float = 1.6,
        dashed: bool = False,
    ) -> None:  # fmt: skip
        """Draw a line through values."""
        places = [self.at(float(a), float(b)) for a, b in zip(x, y, strict=True)]
        self.drawing.line(places, Stroke(colour, width, dashed))

    def column(self, x: float, y: float, colour: str, width: float, hint: str = "") -> None:
        """Draw an upright bar from 0 to a value, centred at ``x``; ``width`` in units of x."""
        left, top = self.at(x - width / 2, max(y, 0.0))
        right, bottom = self.at(x + width / 2, min(y, 0.0))
        self.drawing.add(Rectangle(left, top, right - left, max(bottom - top, 0.5), colour, hint))

    def label(self, x: float, y: float, text: str) -> None:
        """Write a text just above a value."""
        a, b = self.at(x, y)
        self.drawing.add(Text(a, b - 4, text, 9.5, SOFT, "middle"))

    def square(self, x: float, y: float, colour: str, side: float = 9.0) -> None:
        """Draw a square of ``side`` px centred on a value."""
        a, b = self.at(x, y)
        self.drawing.add(Rectangle(a - side / 2, b - side / 2, side, side, colour))

    def bar(self, y: float, x: float, colour: str, width: float, hint: str = "") -> None:
        """Draw a bar from 0 to the right, centred at ``y``; ``width`` in units of y."""
        left, top = self.at(0.0, y + width / 2)
        right, bottom = self.at(x, y - width / 2)
        self.drawing.add(Rectangle(left, top, max(right - left, 0.5), bottom - top, colour, hint))

    def upright(self, x: float, text: str, colour: str, *, line: int = 0) -> None:
        """Draw a dashed vertical line with a text beside it, ``line`` lines below its top.

        The text is on the left where there is no room for it on the right.
        """
        self.line([x, x], [self.y.low, self.y.high], colour, width=1.2, dashed=True)
        place = self.at(x, self.y.high)
        left = place[0] + 3 + DIGIT * len(text) > self.drawing.width
        beside, anchor = (place[0] - 3, "end") if left else (place[0] + 3, "start")
        self.drawing.add(Text(beside, place[1] + 8 + 12 * line, text, 10, colour, anchor))

    def level(self, y: float, text: str, colour: str) -> None:
        """Draw a dashed horizontal line with a text at its right end."""
        self.line([self.x.low, self.x.high], [y, y], colour, width=1.2, dashed=True)
        place = self.at(self.x.high, y)
        self.drawing.add(Text(place[0], place[1] - 4, text, 10, colour, "end"))

    def legend(self, entries: Sequence[tuple[str, str]]) -> None:
        """Draw a legend of (text, colour) at the upper right."""
        x = self.right
        for text, colour in reversed(entries):
            x -= 5.6 * len(text)
            self.drawing.add(Text(x, 13, text, 10.5, SOFT))
            self.drawing.add(Circle(x - 7, 9.5, 3.6, colour))
            x -= 22

    def legend_below(self, entries: Sequence[tuple[str, str]]) -> None:
        """Draw a legend of (text, colour) below the axes, a line per entry, for long texts."""
        for text, colour in entries:
            y = self.drawing.height + 8
            self.drawing.add(Circle(self.left + 4, y - 3.5, 3.6, colour))
            self.drawing.add(Text(self.left + 13, y, text, 10, SOFT))
            self.drawing.extend(15)

    def _make_equal(self) -> None:
        """Give both axes the same number of units per pixel."""
        wide, high = self.right - self.left, self.bottom - self.top
        unit = max((self.x.high - self.x.low) / wide, (self.y.high - self.y.low) / high)
        self.x, self.y = _widened(self.x, unit * wide), _widened(self.y, unit * high)

    def _axes(self) -> None:
        for tick, label in zip(self.x.ticks, self.x.texts, strict=True):
            x, y = self.at(tick, self.y.low)
            if self.x.grid:
                self.drawing.line([(x, self.top), (x, y)], Stroke(GRID, 0.8))
            inside = min(x, self.drawing.width - _width(label) / 2)
            self.drawing.add(Text(inside, y + 14, label, 10, SOFT, "middle"))
        for tick, label in zip(self.y.ticks, self.y.texts, strict=True):
            x, y = self.at(self.x.low, tick)
            if self.y.grid:
                self.drawing.line([(x, y), (self.right, y)], Stroke(GRID, 0.8))
            self.drawing.add(Text(x - 5, y + 3.5, label, 10, SOFT, "end"))
        corners = ((self.left, self.top), (self.left, self.bottom), (self.right, self.bottom))
        self.drawing.add(Line(corners, Stroke(EDGE, 0.9)))
        middle = (self.left + self.right) / 2
        self.drawing.add(Text(middle, self.drawing.height - 6, self.x.title, 10, SOFT, "middle"))
        upright = Text(10, (self.top + self.bottom) / 2, self.y.title, 10, SOFT, "middle",
                       turned=True)  # fmt: skip
        self.drawing.add(upright)


def _widened(axis: Scale, span: float) -> Scale:
    middle = (axis.low + axis.high) / 2
    return Scale(axis.title, middle - span / 2, middle + span / 2, axis.ticks, axis.labels,
                 grid=axis.grid)  # fmt: skip


def distribution(title: str, quantity: str, series: Sequence[tuple[str, Array, str]]) -> Chart:
    """Return the cumulative distribution of each series of (name, values, colour).

    ``quantity`` is the title of the values' axis, which is logarithmic.
    """
    every = [float(v) for _, values, _ in series for v in values]
    chart = Chart(title, logarithmic(quantity, visible(every)), scale("share, %", [0, 100]))
    for _, values, colour in series:
        ordered = np.sort(values)
        if len(ordered) > 400:  # a finer step is no wider than a line
            ordered = ordered[np.linspace(0, len(ordered) - 1, 400).astype(int)]
        x = [v for v in ordered for _ in (0, 1)]
        share = [100.0 * k / len(ordered) for k in range(len(ordered) + 1)]
        y = [v for v in share for _ in (0, 1)]
        chart.line([chart.x.low, *x, chart.x.high], y, colour, width=2.0)
    chart.legend([(name, colour) for name, _, colour in series])
    return chart
