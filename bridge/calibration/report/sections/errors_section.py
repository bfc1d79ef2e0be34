"""Errors before and after: mean, maximum, distribution, per axis, over the workspace."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.report.data import CalibrationData
from gapbridge.bridge.document.axes import Chart, distribution, named, scale
from gapbridge.bridge.document.blocks import Block, Paragraph, Pictures, Table
from gapbridge.bridge.document.drawing import AFTER, BEFORE, EDGE, INK, Circle, Drawing
from gapbridge.bridge.document.numbers import fixed, mm
from gapbridge.bridge.document.skeleton import round_factor
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.result import Errors

LEGEND = (("before", BEFORE), ("after", AFTER))
ARROW_LENGTH = 0.16  # of the workspace's size: drawn length of the 95 % quantile
ERROR_VIEWS = {
    "from above": (("x, m", 0), ("y, m", 1)),
    "from the side": (("x, m", 0), ("z, m", 2)),
}


def before_and_after(data: CalibrationData) -> list[Block]:
    """Return the table of errors, their distribution and the rms per axis."""
    pictures = [_distribution(data)]
    if len(data.axes) > 1:
        pictures.append(_axes(data))
    definition = data.error_definition
    return [
        Paragraph(f"{definition[:1].upper()}{definition[1:]}.", "note"),
        _table(data),
        Pictures(tuple(pictures), _caption(data)),
    ]


def _caption(data: CalibrationData) -> str:
    text = (
        f"On {data.validation_poses}. Distribution: cumulative share of the readings by error, on "
        "a logarithmic axis."
    )
    if data.outlier_rows:
        text += " The table includes outliers."
    if len(data.axes) > 1:
        c = data.calibration
        text += f" Residual along an axis: {mm(c.noise)} (1 sigma)"
        known = np.isfinite(c.noise_floor)
        text += f", noise of arm and instrument {mm(c.noise_floor)}." if known else "."
    return text


def _table(data: CalibrationData) -> Table:
    c = data.calibration
    rows = []
    for name, before, after in (
        ("held out", c.held_out_before, c.held_out_after),
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


def _distribution(data: CalibrationData) -> Drawing:
    before, after = (e.norm * 1e3 for e in data.validation_errors)
    series = [("before", before, BEFORE), ("after", after, AFTER)]
    return distribution("Distribution of the error", "error, mm", series).drawing


def _axes(data: CalibrationData) -> Drawing:
    rms = [np.sqrt(np.mean(e.vector**2, axis=0)) * 1e3 for e in data.validation_errors]
    chart = Chart(
        "Along each axis", named("axis of the base", data.axes),
        scale("rms error, mm", [*rms[0], *rms[1]]),
    )  # fmt: skip
    for shift, values, colour in ((-0.18, rms[0], BEFORE), (0.18, rms[1], AFTER)):
        for i, value in enumerate(values):
            hint = f"{data.axes[i]}: {mm(value * 1e-3)}"
            chart.column(i + shift, float(value), colour, 0.32, hint)
            chart.label(i + shift, float(value), fixed(float(value), 3))
    chart.legend(LEGEND)
    return chart.drawing


def over_the_workspace(data: CalibrationData) -> list[Block]:
    """Return the errors as lines in two views, and a table by zone of the workspace."""
    before, after = data.inlier_errors
    tcp = data.tcp[before.rows]
    zones = _zones(tcp, before, after)
    if not data.measures_position:
        return [zones]
    about = "Each line starts at the predicted position of the tool and shows the error vector."
    size = float(np.ptp(tcp, axis=0).max())
    drawings, factors = [], []
    for name, errors, colour in (("Before", before, BEFORE), ("After", after, AFTER)):
        large = max(float(np.quantile(errors.norm, 0.95)), 1e-9)
        factor = round_factor(ARROW_LENGTH * size / large)
        factors.append(factor)
        for view, axes in ERROR_VIEWS.items():
            title = f"{name}, {view}"
            drawings.append(_view(title, axes, tcp, errors.vector * factor, colour))
    selection = "All readings except outliers." if data.outlier_rows else "All readings."
    caption = (
        f"{selection} Errors before are magnified {factors[0]:,.0f} times,"
        f" errors after {factors[1]:,.0f} times. Axes of the base; the square is the base."
    )
    return [Paragraph(about, "note"), Pictures(tuple(drawings), caption), zones]


def _view(
    title: str, axes: tuple[tuple[str, int], ...], tcp: Array, drawn: Array, colour: str
) -> Drawing:
    (x_title, i), (y_title, j) = axes
    end = tcp + drawn
    x = scale(x_title, [*tcp[:, i], *end[:, i]], tight=True)
    y = scale(y_title, [*tcp[:, j], *end[:, j]], tight=True)
    chart = Chart(title, x, y, height=300, equal=True)
    chart.square(0.0, 0.0, INK)
    for a, b in zip(tcp, end, strict=True):
        chart.line([a[i], b[i]], [a[j], b[j]], colour, width=1.5)
    for a in tcp:
        chart.drawing.add(Circle(*chart.at(a[i], a[j]), 1.5, EDGE))
    return chart.drawing


def _zones(tcp: Array, before: Errors, after: Errors) -> Table:
    """Return mean and largest errors by distance from the base's axis, and by height."""
    reach = np.hypot(tcp[:, 0], tcp[:, 1])
    inner, outer = np.quantile(reach, [1 / 3, 2 / 3])
    middle = float(np.median(tcp[:, 2]))
    zones = [
        (f"near: up to {inner:.2f} m from the base's axis", reach <= inner),
        (f"between {inner:.2f} and {outer:.2f} m", (reach > inner) & (reach <= outer)),
        (f"far: beyond {outer:.2f} m", reach > outer),
        (f"low: tool below {middle:.2f} m", tcp[:, 2] < middle),
        (f"high: tool above {middle:.2f} m", tcp[:, 2] >= middle),
    ]
    rows = [
        [name, str(int(chosen.sum())), *_stats(before.norm[chosen]), *_stats(after.norm[chosen])]
        for name, chosen in zones
        if chosen.any()
    ]
    heads = ("where", "readings", "mean before", "maximum before", "mean after", "maximum after")
    return Table(heads, rows, (2.6, 0.9, 1, 1.2, 1, 1.2), (1, 2, 3, 4, 5))


def _stats(norm: Array) -> tuple[str, str]:
    return mm(float(norm.mean())), mm(float(norm.max()))
