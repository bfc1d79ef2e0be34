"""The poses of the plan, the accuracy by number of poses, and all readings."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.report.data import CalibrationData
from gapbridge.bridge.document.axes import Chart, scale
from gapbridge.bridge.document.blocks import Block, Cell, Paragraph, Pictures, Table
from gapbridge.bridge.document.drawing import AFTER, EDGE, INK, LIMIT, Circle, Drawing
from gapbridge.bridge.document.numbers import degrees, fixed, mm
from gapbridge.bridge.document.skeleton import skeleton
from gapbridge.core.arrays import Array, Index
from gapbridge.core.calibration.plan import Plan

VIEWS = (("The poses, from above", 0, 1), ("The poses, from the side", 0, 2))
AXES = ("x, m", "y, m", "z, m")


def poses(data: CalibrationData) -> list[Block]:
    """Return the arm in its poses, and the expected and the reached accuracy."""
    drawings = [_view(data, *view) for view in VIEWS]
    caption = "The arm in the fitted poses (grey) and the held-out ones (green)."
    blocks: list[Block] = [Pictures(tuple(drawings), caption)]
    if data.plan is not None:
        blocks += _planned(data, data.plan)
    return blocks


def _view(data: CalibrationData, title: str, i: int, j: int) -> Drawing:
    readings = data.calibration.readings
    _, first = np.unique(readings.pose, return_index=True)
    rigid = data.calibration.model.without_terms()
    shapes = [skeleton(rigid, readings.q[k]) for k in first]
    points = np.concatenate(shapes)
    x, y = (scale(AXES[k], [*points[:, k]], tight=True) for k in (i, j))
    chart = Chart(title, x, y, height=300, equal=True)
    held = readings.held_out[first]
    for shape, out in sorted(zip(shapes, held, strict=True), key=lambda pair: bool(pair[1])):
        colour = LIMIT if out else EDGE
        chart.line([*shape[:, i]], [*shape[:, j]], colour, width=0.8)
        chart.drawing.add(Circle(*chart.at(shape[-1, i], shape[-1, j]), 2.4, colour))
    chart.square(0.0, 0.0, INK)
    return chart.drawing


def _planned(data: CalibrationData, plan: Plan) -> list[Block]:
    reached = data.predicted_std
    minutes = plan.travel / 60
    text = (
        f"The plan predicted the position of the tool to {mm(plan.expected.tcp_std)} (1 sigma, rms "
        f"over the workspace; at worst {mm(plan.expected.tcp_std_worst)}); the fit reached "
        f"{mm(reached)} at the validation poses. Travel between the poses takes about "
        f"{minutes:.0f} min."
    )
    blocks: list[Block] = [Paragraph(text)]
    if len(plan.bought) > 1:
        blocks.append(Pictures((_accuracy_chart(plan),), (
            "Expected accuracy by number of fitted poses; dashed: the plan."
        )))  # fmt: skip
    return blocks


def _accuracy_chart(plan: Plan) -> Drawing:
    count = [float(k) for k, _ in plan.bought]
    std = [v * 1e3 for _, v in plan.bought]
    planned = len({p.number for p in plan.poses if not p.held_out})
    known = [v for v in std if np.isfinite(v)]
    top = min(max(known), 8 * min(known)) if known else 1.0
    y = scale("1 sigma of the tool, mm", [top])
    chart = Chart(
        "Accuracy by number of poses", scale("poses in the fit", [*count, planned]), y, width=420
    )
    shown = [(a, b) for a, b in zip(count, std, strict=True) if b <= y.high]
    chart.line([a for a, _ in shown], [b for _, b in shown], AFTER)
    chart.points([a for a, _ in shown], [b for _, b in shown], AFTER, radius=3)
    chart.line([planned, planned], [0.0, y.high], LIMIT, width=1.2, dashed=True)
    return chart.drawing


def all_readings(data: CalibrationData) -> list[Block]:
    """Return the table of all readings."""
    readings = data.calibration.readings
    before, after = (_by_row(e.rows, e.norm, len(readings)) for e in data.all_errors)
    rows: list[list[Cell]] = []
    for i in range(len(readings)):
        used = "outlier" if i in data.outlier_rows else "check" if readings.held_out[i] else "fit"
        rows.append([
            str(i + 1), str(int(readings.pose[i]) + 1), str(int(readings.load[i]) + 1),
            degrees(readings.q[i]), used, _in_mm(before[i]), _in_mm(after[i]),
        ])  # fmt: skip
    heads = ("no.", "pose", "load", "joint angles, degrees", "used for", "before", "after")
    return [Table(heads, rows, (0.5, 0.6, 0.6, 4, 0.8, 0.8, 0.8), (5, 6))]


def _by_row(rows: Index, norm: Array, count: int) -> Array:
    errors = np.full(count, np.nan)
    errors[rows] = norm * 1e3
    return errors


def _in_mm(value: float) -> str:
    return fixed(value, 3) if np.isfinite(value) else "–"
