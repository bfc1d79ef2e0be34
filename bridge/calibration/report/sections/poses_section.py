"""The poses: planned, measured, what more of them would buy; and every reading."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.report.figures import degrees, mm
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.document.axes import Chart, scale
from gapbridge.bridge.document.blocks import Block, Cell, Paragraph, Pictures, Table
from gapbridge.bridge.document.drawing import AFTER, EDGE, INK, LIMIT, Circle, Drawing
from gapbridge.bridge.document.skeleton import skeleton
from gapbridge.bridge.report.labels import fixed
from gapbridge.core.arrays import Array, Index
from gapbridge.core.calibration.plan import Plan

VIEWS = (("The poses, from above", 0, 1), ("The poses, from the side", 0, 2))
AXES = ("x, m", "y, m", "z, m")


def poses(material: Material) -> list[Block]:
    """Return the arm in its poses, and the plan's expectation beside what was reached."""
    drawings = [_view(material, *view) for view in VIEWS]
    caption = "The arm in the poses of the fit (grey) and those kept out of it (green)."
    blocks: list[Block] = [Pictures(tuple(drawings), caption)]
    if material.plan is not None:
        blocks += _planned(material, material.plan)
    return blocks


def _view(material: Material, title: str, i: int, j: int) -> Drawing:
    readings = material.calibration.readings
    _, first = np.unique(readings.pose, return_index=True)
    rigid = material.calibration.model.without_terms()
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


def _planned(material: Material, plan: Plan) -> list[Block]:
    reached = material.predicted_std
    minutes = plan.travel / 60
    text = (
        f"Before anyone moved, the plan expected the tool's place to be known to "
        f"{mm(plan.expected.tcp_std)} (1 sigma, rms over the workspace; at worst "
        f"{mm(plan.expected.tcp_std_worst)}); reached are {mm(reached)} at the poses that judge "
        f"it. Travel between the poses takes about {minutes:.0f} min."
    )
    blocks: list[Block] = [Paragraph(text)]
    if len(plan.bought) > 1:
        blocks.append(Pictures((_bought(plan),), (
            "What so many poses in the fit buy, as the plan expects it; the line is what was "
            "planned."
        )))  # fmt: skip
    return blocks


def _bought(plan: Plan) -> Drawing:
    count = [float(k) for k, _ in plan.bought]
    std = [v * 1e3 for _, v in plan.bought]
    planned = len({p.number for p in plan.poses if not p.held_out})
    known = [v for v in std if np.isfinite(v)]
    most = min(max(known), 8 * min(known)) if known else 1.0
    y = scale("1 sigma of the tool, mm", [most])
    chart = Chart("What poses buy", scale("poses in the fit", [*count, planned]), y, width=420)
    kept = [(a, b) for a, b in zip(count, std, strict=True) if b <= y.high]
    chart.line([a for a, _ in kept], [b for _, b in kept], AFTER)
    chart.points([a for a, _ in kept], [b for _, b in kept], AFTER, radius=3)
    chart.line([planned, planned], [0.0, y.high], LIMIT, width=1.2, dashed=True)
    return chart.drawing


def all_readings(material: Material) -> list[Block]:
    """Return one long table."""
    readings = material.calibration.readings
    before, after = (_by_row(e.rows, e.norm, len(readings)) for e in material.both)
    rows: list[list[Cell]] = []
    for i in range(len(readings)):
        used = (
            "outlier" if i in material.outlier_rows else "check" if readings.held_out[i] else "fit"
        )
        rows.append([
            str(i + 1), str(int(readings.pose[i]) + 1), str(int(readings.load[i]) + 1),
            degrees(readings.q[i]), used, _in_mm(before[i]), _in_mm(after[i]),
        ])  # fmt: skip
    heads = ("no.", "pose", "load", "joint angles, degrees", "used for", "before", "after")
    return [Table(heads, rows, (0.5, 0.6, 0.6, 4, 0.8, 0.8, 0.8), (5, 6))]


def _by_row(rows: Index, norm: Array, count: int) -> Array:
    found = np.full(count, np.nan)
    found[rows] = norm * 1e3
    return found


def _in_mm(value: float) -> str:
    return fixed(value, 3) if np.isfinite(value) else "–"
