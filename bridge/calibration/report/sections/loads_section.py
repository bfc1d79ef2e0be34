"""Before and after over the load; pose accuracy and repeatability in the terms of ISO 9283."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.report.figures import load_title, mm, mrad
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.document.axes import Chart, logarithmic, named, plain, visible
from gapbridge.bridge.document.blocks import Block, Paragraph, Pictures, Table
from gapbridge.bridge.document.drawing import AFTER, BEFORE, Drawing
from gapbridge.bridge.report.labels import counted, fixed
from gapbridge.core.arrays import Array, Index
from gapbridge.core.calibration.budget.pose_accuracy import PoseAccuracy

ASKED = 30  # visits that the standard asks for


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


def pose_accuracy(material: Material) -> list[Block]:
    """Return the table, and how far these visits are what the standard asks for."""
    found = material.accuracies
    if not found:
        return [Paragraph(_none(material))]
    worst = max(found, key=lambda p: p.repeatability)
    before, after = (max(p.accuracy[k] for p in found) for k in (0, 1))
    lead = (
        f"The largest pose accuracy AP is {mm(before)} before and {mm(after)} after the "
        f"calibration; the largest pose repeatability RP is {mm(worst.repeatability)} "
        f"(pose {worst.pose + 1})."
    )
    return [Paragraph(lead), _accuracy_table(found), Paragraph(_note(found), "note")]


def _none(material: Material) -> str:
    if material.calibration.readings.kind not in ("position", "pose"):
        return (
            "AP and RP speak of the tool's position; this instrument does not show it on its own, "
            "so they are not stated."
        )
    return "No pose was visited twice from the same side, so that AP and RP are not stated."


def _accuracy_table(found: tuple[PoseAccuracy, ...]) -> Table:
    turning = any(p.angles is not None for p in found)
    rows = []
    for p in found:
        before, after = p.accuracy
        row = [f"pose {p.pose + 1}", str(p.load + 1), str(p.visits), mm(before), mm(after)]
        row += [_axes(p), mm(p.repeatability)]
        if turning:
            row += [_largest(p.turn), _largest(p.angles)]
        rows.append(row)
    heads = ["pose", "load", "visits", "AP before", "AP after", "AP after along x, y, z (mm)",
             "RP"]  # fmt: skip
    widths = [0.6, 0.6, 0.7, 1.1, 1.1, 2.2, 1.0]
    if turning:
        heads += ["AP of angles after", "RP of angles"]
        widths += [1.1, 1.1]
    return Table(tuple(heads), rows, tuple(widths), tuple(range(1, len(heads))))


def _largest(angles: Array | None) -> str:
    return "–" if angles is None else mrad(float(np.abs(angles).max()))


def _axes(p: PoseAccuracy) -> str:
    return ",  ".join(fixed(float(v) * 1e3, 3) for v in p.after)


def _note(found: tuple[PoseAccuracy, ...]) -> str:
    visits = min(p.visits for p in found)
    unsure = 100 / np.sqrt(2 * (visits - 1))
    text = (
        "AP is the distance of the mean of all visits from the commanded place; commanded is what "
        "the model says (before: the model as the cell had it; after: the calibrated one). RP is "
        "the mean distance of the visits from their own mean, plus three of its standard "
        f"deviations. The standard asks for {ASKED} visits of five poses at rated load and speed; "
        f"here {counted(len(found), 'pose was', 'poses were')} visited {visits} times or more, so "
        f"that a standard deviation is itself known to about {plain(round(unsure))} %. RP includes "
        "the instrument's noise."
    )
    if any(p.angles is not None for p in found):
        text += " Of the three angles the largest is reported."
    if any(p.steered for p in found):
        text += (
            " Where the arm was brought back by hand, what the encoders showed of it was taken out."
        )
    return text
