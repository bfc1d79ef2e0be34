"""Before and after over the load."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.report.figures import load_title, mm
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.document.axes import Chart, logarithmic, named, plain, visible
from gapbridge.bridge.document.blocks import Block, Pictures, Table
from gapbridge.bridge.document.drawing import AFTER, BEFORE, Drawing
from gapbridge.core.arrays import Index


def over_the_load(material: Material) -> list[Block]:
    """Return a picture and a table, one column and one row a load."""
    before, _ = material.inliers
    load = material.calibration.readings.load[before.rows]
    numbers = [int(k) for k in np.unique(load)]
    return [
        Pictures((_picture(material, load, numbers),),
                 "One dot a reading, a line at the mean; powers of ten upwards."),
        _table(material, load, numbers),
    ]  # fmt: skip


def _picture(material: Material, load: Index, numbers: list[int]) -> Drawing:
    before, after = material.inliers
    labels = [f"{plain(_mass(material, k))} kg" for k in numbers]
    chart = Chart(
        "Error by load", named("load on the flange", labels),
        logarithmic("error, mm", visible([*before.norm * 1e3, *after.norm * 1e3])), width=420,
    )  # fmt: skip
    for shift, errors, colour in ((-0.17, before, BEFORE), (0.17, after, AFTER)):
        for place, k in enumerate(numbers):
            norm = errors.norm[load == k] * 1e3
            # spread sideways in a fixed pattern, so that dots do not hide each other
            x = place + shift + 0.1 * (np.arange(len(norm)) * 0.618 % 1 - 0.5)
            chart.points(list(x), list(norm), colour, radius=2.4, opacity=0.6)
            mean = float(norm.mean())
            chart.line(
                [place + shift - 0.13, place + shift + 0.13], [mean, mean], colour, width=2.4
            )
    chart.legend((("before", BEFORE), ("after", AFTER)))
    return chart.drawing


def _mass(material: Material, number: int) -> float:
    """Return the declared mass of a load, kg."""
    calibration = material.calibration
    given = calibration.readings.loads.payload_mass
    if given is None:
        return float(calibration.model.payload_mass)
    return float(np.median(given[calibration.readings.load == number]))


def _table(material: Material, load: Index, numbers: list[int]) -> Table:
    before, after = material.inliers
    plan, rows = material.plan, []
    for k in numbers:
        old, new = before.norm[load == k], after.norm[load == k]
        name = plan.loads[k].name if plan and k < len(plan.loads) else ""
        rows.append([
            load_title(_mass(material, k), name), str(len(old)),
            mm(float(old.mean())), mm(float(old.max())), mm(float(new.mean())),
            mm(float(new.max())),
        ])  # fmt: skip
    heads = ("load", "readings", "mean before", "maximum before", "mean after", "maximum after")
    return Table(heads, rows, (2, 0.9, 1, 1.2, 1, 1.2), (1, 2, 3, 4, 5))
