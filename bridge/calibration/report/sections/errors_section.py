"""Before and after: mean, maximum, distribution, per axis, over the workspace."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.report.figures import mm
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.document.axes import Chart, distribution, named, scale
from gapbridge.bridge.document.blocks import Block, Paragraph, Pictures, Table
from gapbridge.bridge.document.drawing import AFTER, BEFORE, EDGE, INK, Circle, Drawing
from gapbridge.bridge.document.skeleton import round_factor
from gapbridge.bridge.report.labels import fixed
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.result import Errors

LEGEND = (("before", BEFORE), ("after", AFTER))
LONGEST = 0.16  # of the workspace's size: how long a large error is drawn
ERROR_VIEWS = {
    "from above": (("x, m", 0), ("y, m", 1)),
    "from the side": (("x, m", 0), ("z, m", 2)),
}


def before_and_after(material: Material) -> list[Block]:
    """Return the table of figures, the distribution and the axes."""
    pictures = [_distribution(material)]
    if len(material.axes) > 1:
        pictures.append(_axes(material))
    meaning = material.error_meaning
    return [
        Paragraph(f"{meaning[:1].upper()}{meaning[1:]}.", "note"),
        _table(material),
        Pictures(tuple(pictures), _caption(material)),
    ]


def _caption(material: Material) -> str:
    text = (
        f"On {material.judged_on}. Distribution: the share of the readings whose error is at "
        "most so large, errors in powers of ten."
    )
    if material.outlier_rows:
        text += " The table counts outliers too."
    if len(material.axes) > 1:
        c = material.calibration
        text += f" The fit leaves {mm(c.noise)} along an axis (1 sigma)"
        known = np.isfinite(c.noise_floor)
        text += f", arm and instrument alone {mm(c.noise_floor)}." if known else "."
    return text


def _table(material: Material) -> Table:
    c = material.calibration
    rows = []
    for name, before, after in (
        ("kept out of the fit", c.held_out_before, c.held_out_after),
        ("in the fit", c.before, c.after),
    ):
        if len(before.vector):
            rows += [_row(f"{name}, before", before), _row(f"{name}, after", after)]
    heads = ("poses", "readings", "mean", "rms", "95 % below", "maximum")
    return Table(heads, rows, (2.4, 1, 1, 1, 1, 1), (1, 2, 3, 4, 5))


def _row(name: str, errors: Errors) -> list[str]:
    high = float(np.quantile(errors.norm, 0.95))
    figures = [mm(v) for v in (errors.mean, errors.rms, high, errors.max)]
    return [name, str(len(errors.norm)), *figures]


def _distribution(material: Material) -> Drawing:
    before, after = (e.norm * 1e3 for e in material.judged)
    series = [("before", before, BEFORE), ("after", after, AFTER)]
    return distribution("Distribution of the error", "error, mm", series).drawing


def _axes(material: Material) -> Drawing:
    rms = [np.sqrt(np.mean(e.vector**2, axis=0)) * 1e3 for e in material.judged]
    chart = Chart(
        "Along each axis", named("axis of the base", material.axes),
        scale("rms error, mm", [*rms[0], *rms[1]]),
    )  # fmt: skip
    for shift, values, colour in ((-0.18, rms[0], BEFORE), (0.18, rms[1], AFTER)):
        for i, value in enumerate(values):
            hint = f"{material.axes[i]}: {mm(value * 1e-3)}"
            chart.column(i + shift, float(value), colour, 0.32, hint)
            chart.label(i + shift, float(value), fixed(float(value), 3))
    chart.legend(LEGEND)
    return chart.drawing


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
        for view, axes in ERROR_VIEWS.items():
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
