"""The picture of a demo run: the deflected arm, and the TCP error of each pose."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.demo.result import Result, visits_of_poses
from gapbridge.bridge.document.drawing import (
    BAD_DOT,
    BEFORE,
    EDGE,
    INK,
    LIMIT,
    SOFT,
    Circle,
    Drawing,
    Rectangle,
    Stroke,
    Text,
)
from gapbridge.bridge.document.skeleton import skeleton
from gapbridge.core.arrays import Array

WIDTH, HEIGHT = 430.0, 380.0
MAGNIFICATION = 60  # of the drawn deflection
COLOURS = {2: (BAD_DOT, LIMIT), 3: (BAD_DOT, BEFORE, LIMIT)}  # by the number of rounds of visits


def coloured_rounds(result: Result) -> list[tuple[str, Array, str]]:
    """Return name, errors (M,), m, and colour of each round of visits."""
    colours = COLOURS[len(result.rounds)]
    return [(name, e, c) for (name, e), c in zip(result.rounds, colours, strict=True)]


def arm_drawing(result: Result) -> Drawing:
    """Return a side view of the arm at the test visit with the largest error."""
    visit = int(np.argmax(result.error_without))
    q = result.uncompensated.nominal_q[visit]
    load = next(load for load in result.test_loads if load.name == result.loads[visit])
    rigid = skeleton(result.model.without_terms(), q)
    loads = load.rows(1) if result.model.terms else None
    bent = rigid + MAGNIFICATION * (skeleton(result.model, q, loads) - rigid)
    forward = rigid[-1, :2] / np.linalg.norm(rigid[-1, :2])
    side = np.array([[forward[0], 0.0], [forward[1], 0.0], [0.0, 1.0]])  # towards the tool, up
    flat = [points @ side for points in (rigid, bent)]
    low, high = np.vstack(flat).min(axis=0), np.vstack(flat).max(axis=0)
    scale = min(380 / max(high[0] - low[0], 0.1), 280 / max(high[1] - low[1], 0.1))
    middle = (low + high) / 2

    def to_drawing(point: Array) -> tuple[float, float]:
        x, y = (point - middle) * scale
        return WIDTH / 2 + float(x), 185 - float(y)

    drawing = Drawing(WIDTH, HEIGHT, "The arm at one test pose: intended and deflected")
    drawing.add(Text(0, 16, "One test pose, side view", 14, bold=True))
    for points, colour, width in ((flat[0], EDGE, 9.0), (flat[1], BAD_DOT, 4.0)):
        places = [to_drawing(point) for point in points]
        drawing.line(places, Stroke(colour, width))
        for place in places:
            drawing.add(Circle(*place, width / 2 + 1, colour))
    x, y = to_drawing(rigid[0] @ side)
    drawing.add(Rectangle(x - 32, y, 64, 8, INK))
    drawing.add(Text(0, 352, "intended pose", 12.5, SOFT, bold=True))
    text = f"deflected, bending drawn {MAGNIFICATION} times larger"
    drawing.add(Text(0, 371, text, 12.5, BAD_DOT, bold=True))
    return drawing


def bars_drawing(result: Result) -> Drawing:
    """Return the error of each test pose, without and with compensation."""
    left, width = 60.0, 320.0
    poses, rounds = visits_of_poses(result), coloured_rounds(result)
    longest = float(rounds[0][1].max())
    step = min(284 / len(poses), 34)
    drawing = Drawing(WIDTH, HEIGHT, "TCP error without and with compensation")
    title = "Distance of the TCP from the intended position, mm"
    drawing.add(Text(0, 16, title, 14, bold=True))
    for number, rows in enumerate(poses):
        y = 34 + number * step
        drawing.add(Text(0, y + step * 0.5, f"pose {number + 1}", 11, SOFT))
        height = step * 0.74 / len(rounds)
        for k, (_, error, colour) in enumerate(rounds):
            value = float(error[rows].mean())
            length, top = max(width * value / longest, 1.0), y + k * height
            drawing.add(Rectangle(left, top, length, height - 0.8, colour))
            figure = f"{value * 1e3:.2f}"
            drawing.add(Text(left + length + 5, top + height - 1.5, figure, 9, colour))
    lines = [
        (f"{name}: {np.sqrt(np.mean(error**2)) * 1e3:.3f} mm rms", colour)
        for name, error, colour in rounds
    ]
    lines.append((f"repeatability of the arm {result.repeatability * 1e3:.3f} mm", SOFT))
    for k, (text, colour) in enumerate(reversed(lines)):
        drawing.add(Text(0, 374 - 16 * k, text, 12.5, colour, bold=True))
    return drawing


def picture(result: Result) -> Drawing:
    """Return the side view and the error bars next to each other, as one drawing."""
    arm, bars = arm_drawing(result), bars_drawing(result)
    both = Drawing(2 * WIDTH + 40, HEIGHT, bars.title, [*arm.shapes])
    for shape in bars.shapes:
        both.add(shape.moved(WIDTH + 40, 0.0))
    return both
