"""Errors by load; pose accuracy and repeatability by ISO 9283."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.report.data import CalibrationData
from gapbridge.bridge.document.axes import Chart, logarithmic, named, visible
from gapbridge.bridge.document.blocks import Block, Paragraph, Pictures, Table
from gapbridge.bridge.document.drawing import AFTER, BEFORE, Drawing
from gapbridge.bridge.document.numbers import fixed, load_title, mm, mrad, plain
from gapbridge.bridge.report.labels import counted
from gapbridge.core.arrays import Array, Index
from gapbridge.core.calibration.budget.pose_accuracy import PoseAccuracy

ISO_VISITS = 30  # visits of each pose required by ISO 9283


def over_the_load(data: CalibrationData) -> list[Block]:
    """Return a chart and a table of the errors by load."""
    before, _ = data.inlier_errors
    load = data.calibration.readings.load[before.rows]
    numbers = [int(k) for k in np.unique(load)]
    return [
        Pictures((_picture(data, load, numbers),),
                 "One dot per reading, a line at the mean; logarithmic."),
        _table(data, load, numbers),
    ]  # fmt: skip


def _picture(data: CalibrationData, load: Index, numbers: list[int]) -> Drawing:
    before, after = data.inlier_errors
    labels = [f"{plain(_mass(data, k))} kg" for k in numbers]
    chart = Chart(
        "Error by load", named("load on the flange", labels),
        logarithmic("error, mm", visible([*before.norm * 1e3, *after.norm * 1e3])), width=420,
    )  # fmt: skip
    for shift, errors, colour in ((-0.17, before, BEFORE), (0.17, after, AFTER)):
        for place, k in enumerate(numbers):
            norm = errors.norm[load == k] * 1e3
            # a fixed sideways pattern keeps dots from overlapping
            x = place + shift + 0.1 * (np.arange(len(norm)) * 0.618 % 1 - 0.5)
            chart.points(list(x), list(norm), colour, radius=2.4, opacity=0.6)
            mean = float(norm.mean())
            chart.line(
                [place + shift - 0.13, place + shift + 0.13], [mean, mean], colour, width=2.4
            )
    chart.legend((("before", BEFORE), ("after", AFTER)))
    return chart.drawing


def _mass(data: CalibrationData, number: int) -> float:
    """Return the declared mass of a load, kg."""
    calibration = data.calibration
    masses = calibration.readings.loads.payload_mass
    if masses is None:
        return float(calibration.model.payload_mass)
    return float(np.median(masses[calibration.readings.load == number]))


def _table(data: CalibrationData, load: Index, numbers: list[int]) -> Table:
    before, after = data.inlier_errors
    plan, rows = data.plan, []
    for k in numbers:
        old, new = before.norm[load == k], after.norm[load == k]
        name = plan.loads[k].name if plan and k < len(plan.loads) else ""
        rows.append([
            load_title(_mass(data, k), name), str(len(old)),
            mm(float(old.mean())), mm(float(old.max())), mm(float(new.mean())),
            mm(float(new.max())),
        ])  # fmt: skip
    heads = ("load", "readings", "mean before", "maximum before", "mean after", "maximum after")
    return Table(heads, rows, (2, 0.9, 1, 1.2, 1, 1.2), (1, 2, 3, 4, 5))


def pose_accuracy(data: CalibrationData) -> list[Block]:
    """Return AP and RP, and how the visits differ from those that ISO 9283 requires."""
    accuracies = data.pose_accuracies
    if not accuracies:
        return [Paragraph(_not_given(data))]
    worst = max(accuracies, key=lambda p: p.repeatability)
    before, after = (max(p.accuracy[k] for p in accuracies) for k in (0, 1))
    lead = (
        f"The largest pose accuracy AP is {mm(before)} before and {mm(after)} after the "
        f"calibration; the largest pose repeatability RP is {mm(worst.repeatability)} "
        f"(pose {worst.pose + 1})."
    )
    return [
        Paragraph(lead),
        _accuracy_table(accuracies),
        Paragraph(_accuracy_note(accuracies), "note"),
    ]


def _not_given(data: CalibrationData) -> str:
    if data.calibration.readings.kind not in ("position", "pose"):
        return (
            "AP and RP refer to the position of the tool, which this instrument does not measure; "
            "they are not given."
        )
    return "No pose was visited twice from the same direction; AP and RP are not given."


def _accuracy_table(accuracies: tuple[PoseAccuracy, ...]) -> Table:
    turning = any(p.angles is not None for p in accuracies)
    rows = []
    for p in accuracies:
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


def _accuracy_note(accuracies: tuple[PoseAccuracy, ...]) -> str:
    visits = min(p.visits for p in accuracies)
    share = 100 / np.sqrt(2 * (visits - 1))
    text = (
        "AP is the distance of the mean of all visits from the commanded position, which is the "
        "model's (before: the cell's previous model; after: the calibrated one). RP is the mean "
        "distance of the visits from their own mean, plus three of its standard deviations. The "
        f"standard requires {ISO_VISITS} visits of five poses at rated load and speed; here "
        f"{counted(len(accuracies), 'pose was', 'poses were')} visited {visits} times or more, so "
        f"that a standard deviation is known to about {plain(round(share))} %. RP includes the "
        "instrument's noise."
    )
    if any(p.angles is not None for p in accuracies):
        text += " Of the three angles the largest is given."
    if any(p.steered for p in accuracies):
        text += (
            " If the arm was jogged back to a pose, the difference of its encoders was subtracted."
        )
    return text
