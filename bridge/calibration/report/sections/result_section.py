"""The result, the next steps, and the uncertainty budget after the GUM."""

from __future__ import annotations

import math

import numpy as np

from gapbridge.bridge.calibration.report.data import CalibrationData
from gapbridge.bridge.cell.settings.calibration import FEWEST_HELD_OUT
from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.notes import calibration_text
from gapbridge.bridge.document.numbers import mm, mm_fine, number, percent, unit_of, with_unit
from gapbridge.bridge.report.labels import listed, parameter_title, sentence
from gapbridge.core.calibration.budget.budget import Budget
from gapbridge.core.calibration.budget.inputs import Basis, Input
from gapbridge.core.calibration.budget.sensitivity import Sensitivities, Sensitivity

REPEATABILITY = "repeatability of the arm"
UNEXPLAINED = "what the model does not explain"
INPUTS = {
    Basis.COVARIANCE: ("parameters of the model", "covariance of {0} parameters from {1} "
                       "coordinates, propagated to the tool"),
    Basis.REPEATS: (REPEATABILITY, "poses visited again: {0}, with {1} readings"),
    Basis.FIT_SCATTER: (REPEATABILITY, "too few repeats: scatter of the fit without the "
                        "instrument's share"),
    Basis.HELD_OUT: (UNEXPLAINED, "{0} coordinates of the held-out poses"),
    Basis.FITTED: (UNEXPLAINED, "{0} coordinates of the fitted poses (none were held out)"),
}  # fmt: skip
NOT_INCLUDED = (
    "the largest permissible error of the instrument",
    "the temperature of the air during the session",
    "the uncertainty of the loads' masses",
    "the position of the robot's base: all results are in the base frame",
    "changes after this session: wear, a collision, a tool that was removed and mounted again",
)


def summary(data: CalibrationData) -> list[blocks.Block]:
    """Return the verdict, the next steps and the main figures."""
    c = data.calibration
    before, after = data.validation_errors
    badge = data.completeness if after.mean < before.mean else blocks.Badge(
        "No improvement", blocks.BAD
    )  # fmt: skip
    tiles = [
        blocks.Tile("mean error before", mm(before.mean), f"at most {mm(before.max)}"),
        blocks.Tile("mean error after", mm(after.mean), f"at most {mm(after.max)}"),
        blocks.Tile("smaller by", _times(before.mean, after.mean),
                    f"over {len(after.norm)} readings"),
        blocks.Tile("expanded uncertainty (k = 2)", f"± {mm(data.budget.expanded)}",
             "of one coordinate of the tool"),
    ]  # fmt: skip
    text = f"Errors are those of {data.validation_poses}: {data.error_definition}."
    if not data.measures_position:
        text += (
            " Such readings contain a part of the tool's position only: its accuracy is given by "
            "the uncertainty, not by these errors."
        )
    outliers = [r for r in data.validation_errors[1].rows if r in data.outlier_rows]
    if outliers and data.has_held_out:
        rows = listed([str(int(r) + 1) for r in outliers])
        text += (
            f" Outliers (reading {rows}) are to be measured again; the uncertainty excludes them."
        )
    required = [] if data.session.accuracy is None else [required_accuracy(data)]
    return [
        blocks.Verdict(badge, sentence(calibration_text(c, parameter_title))), *required,
        blocks.Heading("What to do now"), blocks.Bullets(tuple(next_steps(data))),
        blocks.Tiles(tuple(tiles)),
        blocks.Paragraph(text, "note"),
    ]  # fmt: skip


def next_steps(data: CalibrationData) -> list[str]:
    """Return what the user does next, most urgent first."""
    before, after = data.validation_errors
    if not after.mean < before.mean:
        return [
            "Do not use this calibration. Check loads, readings and instrument for a mistake (“All "
            "readings” lists the errors), and measure again."
        ]
    steps = []
    if [r for r in after.rows if r in data.outlier_rows] and data.has_held_out:
        steps.append("Measure the outlier readings again.")
    required = data.session.accuracy
    if required is not None and after.max > required:
        steps.append(
            "The required accuracy is not met: measure more poses (“Accuracy by number of poses”), "
            "or what “The residual” recommends."
        )
    if not data.calibration.complete:
        steps.append(
            "The fitted effects do not explain all errors: see “The residual”, recalibrate with "
            "the effects that it names, or have the arm inspected."
        )
    return [
        *steps,
        "Run the calibrated cell without writing first (gapbridge run CELL --observe), then let it "
        "write (gapbridge run CELL --arm).",
        "Verify it after some months, and after every collision, repair or change of the "
        "tool: gapbridge calibrate CELL --verify.",
    ]


def required_accuracy(data: CalibrationData) -> blocks.Verdict:
    """Return whether the required accuracy is met by the largest error of a held-out pose."""
    required = data.session.accuracy or 0.0
    after = data.calibration.held_out_after
    poses = len(np.unique(data.calibration.readings.pose[after.rows]))
    rule = f"Required: no error of a held-out pose above {mm(required)}."
    if poses < FEWEST_HELD_OUT or not data.measures_position:
        problem = (
            f"{poses} such poses were measured, expected {FEWEST_HELD_OUT} or more"
            if data.measures_position else "such readings contain part of the tool's position only"
        )  # fmt: skip
        return blocks.Verdict(
            blocks.Badge("Not decided", blocks.DOUBTFUL), f"{rule} Not decided: {problem}."
        )
    met = after.max <= required
    badge = blocks.Badge("Pass", blocks.GOOD) if met else blocks.Badge("Fail", blocks.BAD)
    text = f"{rule} Found: at most {mm(after.max)} over {poses} poses, instrument noise included."
    return blocks.Verdict(badge, text)


def _times(before: float, after: float) -> str:
    return f"{before / after:.1f} times" if after > 0 else "unknown"


def uncertainty_budget(data: CalibrationData) -> list[blocks.Block]:
    """Return the uncertainty, its budget and check, the parameters' shares, what is excluded."""
    budget = data.budget
    shown: list[blocks.Block] = [blocks.Paragraph(_result_text(budget)), _table(budget)]
    shown.append(
        blocks.Bullets(tuple(f"{INPUTS[i.basis][0]}: {_source_text(i)}" for i in budget.inputs))
    )
    shown.append(blocks.Paragraph(_coverage_text(budget)))
    if budget.looked_at:
        shown += [blocks.Heading("Check against the held-out poses"),
                   blocks.Paragraph(_check_text(budget))]  # fmt: skip
    if budget.parameters is not None:
        shown += _contributions(budget.parameters)
    return [*shown, blocks.Heading("Not in the budget"), blocks.Bullets(NOT_INCLUDED)]


def _source_text(i: Input) -> str:
    """Return the data that an input is computed from."""
    text = INPUTS[i.basis][1].format(*i.values)
    if i.basis not in (Basis.HELD_OUT, Basis.FITTED):
        return text
    outliers = ", ".join(str(row + 1) for row in i.values[1])
    without = f", without outliers (reading {outliers})" if outliers else ""
    rest = "the part" if i.std else "no part"
    return f"{text}{without}: {rest} that the lines above do not explain"


def _result_text(budget: Budget) -> str:
    return (
        f"Along each axis the tool is within ± {mm(budget.expanded)} of where the calibrated model "
        f"puts it (expanded uncertainty, k = 2, about {percent(budget.coverage)}); in space, "
        f"95 % of the poses are within {mm(budget.expanded_length)} of it. This is valid "
        "for the workspace and the loads that were measured."
    )


def _table(budget: Budget) -> blocks.Table:
    rows: list[list[blocks.Cell]] = [_row(i, budget.combined) for i in budget.inputs]
    rows.append(
        ["combined standard uncertainty", mm_fine(budget.combined), _freedom(budget.freedom), ""]
    )
    rows.append(["expanded uncertainty, k\u00a0=\u00a02", mm_fine(budget.expanded), "", ""])
    heads = ("input", "standard uncertainty", "degrees of freedom", "share")
    return blocks.Table(heads, rows, (2.5, 1.3, 1.3, 1.5), (1, 2), sums=2)


def _row(i: Input, combined: float) -> list[blocks.Cell]:
    share = (i.std / combined) ** 2 if combined else 0.0
    return [
        INPUTS[i.basis][0], mm_fine(i.std), _freedom(i.freedom),
        blocks.Bar(share, f"{share * 100:.0f} %"),
    ]  # fmt: skip


def _freedom(freedom: float) -> str:
    return f"{freedom:.0f}" if math.isfinite(freedom) else "∞"


def _coverage_text(budget: Budget) -> str:
    text = (
        "All inputs are of type A, from the readings of this session, with normal distributions "
        "and a sensitivity of 1. The scatter includes the instrument's noise, which "
        "is therefore not counted again."
    )
    if math.isfinite(budget.freedom):
        text += (
            f" Effective degrees of freedom (Welch and Satterthwaite): {budget.freedom:.0f}; with "
            f"them k = 2 covers {budget.coverage * 100:.1f} %, and 95.45 % would need "
            f"k = {budget.needed_factor:.2f}."
        )
    return text


def _check_text(budget: Budget) -> str:
    share = budget.inside / budget.looked_at
    text = (
        f"Of {budget.looked_at} coordinates not used in the fit, {budget.inside} "
        f"({percent(share)}) are within ± {mm(budget.bound)}: twice the combined uncertainty and "
        f"the noise of one reading together. {percent(budget.coverage)} were expected"
    )
    if budget.doubtful:
        return f"{text}; these are significantly fewer: the budget is too small."
    return f"{text}: they agree with the budget."


def _contributions(budget: Sensitivities) -> list[blocks.Block]:
    rows: list[list[blocks.Cell]] = [
        _parameter(s) for s in sorted(budget.each, key=lambda s: -s.contribution)
    ]
    size = math.sqrt(abs(budget.correlation))
    sign = "+" if budget.correlation >= 0 else "−"
    rows.append(["correlations between them", "", "", f"{sign} {mm_fine(size)}"])
    rows.append([blocks.Strong("together"), "", "", mm_fine(budget.combined)])
    heads = ("parameter", "standard uncertainty", "sensitivity", "contribution")
    note = (
        "Sensitivity: motion of the tool along an axis, rms over the validation poses. Large "
        "contributions of correlated parameters cancel through their correlations; contributions "
        "add in squares."
    )
    return [
        blocks.Heading("Contributions to “parameters of the model”"),
        blocks.Table(heads, rows, (3, 1.6, 1.6, 1.2), (1, 2, 3), sums=2),
        blocks.Paragraph(note, "note"),
    ]


def _parameter(s: Sensitivity) -> list[blocks.Cell]:
    unit, factor = unit_of(s.unit)
    coefficient = s.coefficient * 1e3 / factor
    small = coefficient < 1e-3
    per = f"{number(coefficient * (1e3 if small else 1.0))} {'µm' if small else 'mm'} per {unit}"
    return [
        parameter_title(s.name), with_unit(s.std, s.unit), per,
        mm_fine(s.contribution),
    ]  # fmt: skip
