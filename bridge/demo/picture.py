"""The picture of a demo run as SVG: the arm as it hangs, and the error pose by pose."""

from __future__ import annotations

from html import escape

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.demo.poses import Load
from gapbridge.bridge.demo.result import Result, visits_of_poses
from gapbridge.core.kernels import reference as kernel
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

Array = NDArray[np.float64]
WIDTH, HEIGHT = 960, 420
MAGNIFIED = 60  # times the bending is drawn larger
INK, FAINT, RED, GREEN = "#1f2933", "#9aa5b1", "#d64545", "#2f9e5b"
AMBER = "#d9902f"


def skeleton(model: Model, q: Array, load: Load) -> Array:
    """Return base, joint origins, flange and TCP (n+3, 3) in base, bent as the model says."""
    shape = kernel.new_shape(model.arm.n)
    rows = model.rows(q[None], load.rows(1) if model.terms else Loads())
    kernel.equilibrium(model.chain(), rows, 0, shape)
    return np.vstack([np.zeros(3), shape.origin, shape.tcp_position])


def picture(result: Result) -> str:
    """Return the whole picture."""
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'width="{WIDTH}" height="{HEIGHT}" font-family="system-ui, sans-serif" '
        f'role="img" aria-label="TCP error without and with compensation">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="#ffffff"/>',
        _arm(result),
        _bars(result),
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _text(x: float, y: float, text: str, size: int = 13, colour: str = INK, more: str = "") -> str:
    place = f'x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{colour}"'
    return f"<text {place} {more}>{escape(text)}</text>"


def _bold(x: float, y: float, text: str, colour: str = INK, size: int = 13) -> str:
    return _text(x, y, text, size, colour, 'font-weight="600"')


def _arm(result: Result) -> str:
    """Draw the arm at the test visit with the largest error, seen from its side."""
    visit = int(np.argmax(result.error_without))
    q = result.without.nominal_q[visit]
    load = next(known for known in result.test_loads if known.name == result.loads[visit])
    rigid = skeleton(result.model.without_terms(), q, load)
    bent = rigid + MAGNIFIED * (skeleton(result.model, q, load) - rigid)
    ahead = rigid[-1, :2] / np.linalg.norm(rigid[-1, :2])
    side = np.array([[ahead[0], 0.0], [ahead[1], 0.0], [0.0, 1.0]])  # towards the tool, up
    drawn = [points @ side for points in (rigid, bent)]
    both = np.vstack(drawn)
    low, high = both.min(axis=0), both.max(axis=0)
    scale = min(380 / max(high[0] - low[0], 0.1), 270 / max(high[1] - low[1], 0.1))
    middle = (low + high) / 2

    def at(point: Array) -> tuple[float, float]:
        return 225 + (point[0] - middle[0]) * scale, 225 - (point[1] - middle[1]) * scale

    parts = [_bold(30, 34, "One test pose, seen from the side", size=16)]
    for points, colour, width in ((drawn[0], FAINT, 9), (drawn[1], RED, 4)):
        places = [at(point) for point in points]
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        stroke = f'stroke="{colour}" stroke-width="{width}"'
        parts.append(f'<polyline points="{line}" fill="none" stroke-linejoin="round" {stroke}/>')
        stroke = f'r="{width / 2 + 1:.1f}" fill="#ffffff" stroke="{colour}" stroke-width="2"'
        parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" {stroke}/>' for x, y in places]
    x, y = at(rigid[0] @ side)
    parts.append(f'<rect x="{x - 32:.1f}" y="{y:.1f}" width="64" height="8" fill="{INK}"/>')
    parts.append(_bold(30, 388, "where it was wanted", "#6b7785"))
    parts.append(_bold(30, 406, f"how it hangs, bending drawn {MAGNIFIED} times larger", RED))
    return "\n".join(parts)


def _bars(result: Result) -> str:
    """Draw error without and with compensation for each test pose."""
    left, top, width = 560, 58, 300
    poses = visits_of_poses(result)
    colours = (RED, AMBER, GREEN) if len(result.series) == 3 else (RED, GREEN)
    series = [(e * 1e3, c) for (_, e), c in zip(result.series, colours, strict=True)]
    longest = float(series[0][0].max())
    step = min(284 / len(poses), 34)
    parts = [_bold(490, 34, "Distance of the TCP from where it was wanted, mm", size=16)]
    for number, rows in enumerate(poses):
        y = top + number * step
        parts.append(_text(490, y + step * 0.55, f"pose {number + 1}", 12, FAINT))
        for k, (values, colour) in enumerate(series):
            value = float(values[rows].mean())
            height = step * 0.72 / len(series)
            length = max(width * value / longest, 1.0)
            y_bar = y + k * (height + 1)
            parts.append(f'<rect x="{left}" y="{y_bar:.1f}" width="{length:.1f}" '
                         f'height="{height:.1f}" fill="{colour}"/>')  # fmt: skip
            parts.append(_text(left + length + 5, y_bar + height - 1, f"{value:.2f}", 10, colour))
    lines = [
        (f"{name} {np.sqrt(np.mean(error**2)) * 1e3:.3f} mm rms", colour)
        for (name, error), colour in zip(result.series, colours, strict=True)
    ]
    lines.append((f"the arm repeats to {result.repeatability * 1e3:.3f} mm", "#6b7785"))
    for k, (text, colour) in enumerate(reversed(lines)):
        parts.append(_bold(490, 410 - 17 * k, text, colour))
    return "\n".join(parts)
