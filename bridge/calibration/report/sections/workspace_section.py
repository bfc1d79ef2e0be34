"""Before and after over the workspace: where the errors lie, and which way they point."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.report.figures import mm
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.document.axes import Chart, scale
from gapbridge.bridge.document.blocks import Block, Paragraph, Pictures, Table
from gapbridge.bridge.document.drawing import AFTER, BEFORE, EDGE, INK, Circle, Drawing
from gapbridge.bridge.document.skeleton import round_factor
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.result import Errors

LONGEST = 0.16  # of the workspace's size: how long a large error is drawn
VIEWS = {"from above": (("x, m", 0), ("y, m", 1)), "from the side": (("x, m", 0), ("z, m", 2))}


def over_the_workspace(material: Material) -> list[Block]:
    """Return the errors as arrows, from two sides, and a table of zones."""
    before, after = material.inliers
    tip = material.tip[before.rows]
    zones = _zones(tip, before, after)
    if not material.shows_places:
        return [zones]
    about = "Each line begins where the tool was meant to be and shows which way it was off."
    size = float(np.ptp(tip, axis=0).max())
    drawings, factors = [], []
    for name, errors, colour in (("Before", before, BEFORE), ("After", after, AFTER)):
        factor = _factor(errors, size)
        factors.append(factor)
        for view, axes in VIEWS.items():
            title = f"{name}, {view}"
            drawings.append(_view(title, axes, tip, errors.vector * factor, colour))
    caption = (
        f"{_all(material)} Errors before are drawn {factors[0]:,.0f} times as long as they are,"
        f" errors after {factors[1]:,.0f} times. Axes of the base; the square is the base."
    )
    return [Paragraph(about, "note"), Pictures(tuple(drawings), caption), zones]


def _all(material: Material) -> str:
    return "All readings but the outliers." if material.outlier_rows else "All readings."


def _factor(errors: Errors, size: float) -> float:
    """Return a round factor that draws a large error as a tenth of the workspace or so."""
    rough = LONGEST * size / max(float(np.quantile(errors.norm, 0.95)), 1e-9)
    return round_factor(rough)


def _view(
    title: str, axes: tuple[tuple[str, int], ...], tip: Array, drawn: Array, colour: str
) -> Drawing:
    (x_title, i), (y_title, j) = axes
    end = tip + drawn
    x = scale(x_title, [*tip[:, i], *end[:, i]], tight=True)
    y = scale(y_title, [*tip[:, j], *end[:, j]], tight=True)
    chart = Chart(title, x, y, height=300, equal=True)
    chart.square(0.0, 0.0, INK)
    for a, b in zip(tip, end, strict=True):
        chart.line([a[i], b[i]], [a[j], b[j]], colour, width=1.5)
    for a in tip:
        chart.drawing.add(Circle(*chart.at(a[i], a[j]), 1.5, EDGE))
    return chart.drawing


def _zones(tip: Array, before: Errors, after: Errors) -> Table:
    """Return mean and largest errors near, in the middle and far out; low and high."""
    reach = np.hypot(tip[:, 0], tip[:, 1])
    inner, outer = np.quantile(reach, [1 / 3, 2 / 3])
    middle = float(np.median(tip[:, 2]))
    zones = [
        (f"near: up to {inner:.2f} m from the base's axis", reach <= inner),
        (f"between {inner:.2f} and {outer:.2f} m", (reach > inner) & (reach <= outer)),
        (f"far: beyond {outer:.2f} m", reach > outer),
        (f"low: tool below {middle:.2f} m", tip[:, 2] < middle),
        (f"high: tool above {middle:.2f} m", tip[:, 2] >= middle),
    ]
    rows = [
        [name, str(int(chosen.sum())), *_pair(before.norm[chosen]), *_pair(after.norm[chosen])]
        for name, chosen in zones
        if chosen.any()
    ]
    heads = ("where", "readings", "mean before", "maximum before", "mean after", "maximum after")
    return Table(heads, rows, (2.6, 0.9, 1, 1.2, 1, 1.2), (1, 2, 3, 4, 5))


def _pair(norm: Array) -> tuple[str, str]:
    return mm(float(norm.mean())), mm(float(norm.max()))
