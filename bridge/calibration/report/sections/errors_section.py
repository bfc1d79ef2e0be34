"""Before and after: mean, maximum, distribution, per axis."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.report.figures import fixed, mm
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.document.axes import Chart, distribution, named, scale
from gapbridge.bridge.document.blocks import Block, Paragraph, Pictures, Table
from gapbridge.bridge.document.drawing import AFTER, BEFORE, Drawing
from gapbridge.core.calibration.result import Errors

LEGEND = (("before", BEFORE), ("after", AFTER))


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
