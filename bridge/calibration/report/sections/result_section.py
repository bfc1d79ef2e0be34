"""The result and its uncertainty budget, in the manner of the GUM."""

from __future__ import annotations

import math

import numpy as np

from gapbridge.bridge.calibration.report.figures import fine, mm
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.cell.settings.calibration import FEWEST_HELD_OUT
from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.notes import calibration_text
from gapbridge.bridge.report.labels import (
    listed,
    number,
    parameter_title,
    percent,
    sentence,
    unit_of,
    with_unit,
)
from gapbridge.core.calibration.budget.budget import Budget
from gapbridge.core.calibration.budget.inputs import Basis, Input
from gapbridge.core.calibration.budget.sensitivity import Sensitivities, Sensitivity

REPEATABILITY = "repeatability of the arm"
UNEXPLAINED = "what the model does not explain"
INPUTS = {
    Basis.COVARIANCE: ("parameters of the model", "covariance of {0} parameters from {1} "
                       "coordinates, carried to the tool"),
    Basis.REPEATS: (REPEATABILITY, "poses visited again: {0}, with {1} readings"),
    Basis.FIT_SCATTER: (REPEATABILITY, "too few repeats: scatter of the fit without the "
                        "instrument's share"),
    Basis.HELD_OUT: (UNEXPLAINED, "{0} coordinates of the held-out poses"),
    Basis.FITTED: (UNEXPLAINED, "{0} coordinates of the fitted poses (none were held out)"),
}  # fmt: skip
OUTSIDE = (
    "the largest permissible error of the instrument",
    "the temperature of the air during the session",
    "how well the masses of the loads are known",
    "where the robot's base stands in the hall: everything here is seen from the base",
    "changes after this session: wear, a collision, a tool that was taken off and put on again",
)


def summary(material: Material) -> list[blocks.Block]:
    """Return the verdict and the large figures."""
    c = material.calibration
    before, after = material.judged
    badge = (
        blocks.Badge("Complete", blocks.GOOD)
        if c.complete
        else blocks.Badge("Not complete", blocks.DOUBTFUL)
    )
    if not after.mean < before.mean:
        badge = blocks.Badge("No improvement", blocks.BAD)
    tiles = [
        blocks.Tile("mean error before", mm(before.mean), f"at most {mm(before.max)}"),
        blocks.Tile("mean error after", mm(after.mean), f"at most {mm(after.max)}"),
        blocks.Tile("smaller by", _times(before.mean, after.mean),
                    f"over {len(after.norm)} readings"),
        blocks.Tile("expanded uncertainty (k = 2)", f"± {mm(material.budget.expanded)}",
             "of one coordinate of the tool"),
    ]  # fmt: skip
    text = f"Errors are those of {material.judged_on}: {material.error_meaning}."
    if not material.shows_places:
        text += (
            " Such readings show a part of where the tool is: how well its place is known "
            "stands in the uncertainty, not in these errors."
        )
    outliers = [r for r in material.judged[1].rows if r in material.outlier_rows]
    if outliers and material.held_out:
        rows = listed([str(int(r) + 1) for r in outliers])
        text += (
            f" Among them {'is reading' if len(outliers) == 1 else 'are readings'} {rows}, far "
            "beyond all others: to be measured again. The uncertainty does not count it."
        )
    asked = [] if material.session.accuracy is None else [_asked(material)]
    return [
        blocks.Verdict(badge, sentence(calibration_text(c, parameter_title))), *asked,
        blocks.Heading("What to do now"), blocks.Bullets(tuple(next_steps(material))),
        blocks.Tiles(tuple(tiles)),
        blocks.Paragraph(text, "note"),
    ]  # fmt: skip


def next_steps(material: Material) -> list[str]:
    """Return what the user does next, most urgent first."""
    before, after = material.judged
    if not after.mean < before.mean:
        return [
            "Do not use this calibration. Look for a mistake among loads, readings and instrument "
            "(“All readings” has the errors), and measure again."
        ]
    steps = []
    if [r for r in after.rows if r in material.outlier_rows] and material.held_out:
        steps.append("Measure the readings again that are far beyond all others.")
    asked = material.session.accuracy
    if asked is not None and after.max > asked:
        steps.append(
            "The accuracy asked for is not shown: measure more poses (“What poses buy”), or what "
            "else “The residual” names."
        )
    if not material.calibration.complete:
        steps.append(
            "The fitted effects do not explain everything: see what “The residual” names, and "
            "calibrate with it, or have the arm looked at."
        )
    return [
        *steps,
        "Watch the calibrated cell first (gapbridge run CELL --observe), then let it write "
        "(gapbridge run CELL --arm).",
        "Check it again after some months, and after every collision, repair or change of the "
        "tool: gapbridge calibrate CELL --verify.",
    ]


def _asked(material: Material) -> blocks.Verdict:
    """Return whether the accuracy asked for is met: by the farthest pose kept out of the fit."""
    asked = material.session.accuracy or 0.0
    after = material.calibration.held_out_after
    poses = len(np.unique(material.calibration.readings.pose[after.rows]))
    rule = f"Asked for: no pose kept out of the fit farther off than {mm(asked)}."
    if poses < FEWEST_HELD_OUT or not material.shows_places:
        found = (
            f"{poses} such poses were measured, expected {FEWEST_HELD_OUT} or more"
            if material.shows_places else "such readings show a part of where the tool is"
        )  # fmt: skip
        return blocks.Verdict(
            blocks.Badge("Not decided", blocks.DOUBTFUL), f"{rule} Not decided: {found}."
        )
    met = after.max <= asked
    word = blocks.Badge("Pass", blocks.GOOD) if met else blocks.Badge("Fail", blocks.BAD)
    text = (
        f"{rule} Found: at most {mm(after.max)} over {poses} poses, the instrument's noise in it."
    )
    return blocks.Verdict(word, text)


def _times(before: float, after: float) -> str:
    return f"{before / after:.1f} times" if after > 0 else "unknown"


def uncertainty_budget(material: Material) -> list[blocks.Block]:
    """Return the result, the budget, its check, what stands behind it and what is not in it."""
    given = material.budget
    shown: list[blocks.Block] = [blocks.Paragraph(_result(given)), _table(given)]
    shown.append(blocks.Bullets(tuple(f"{INPUTS[i.basis][0]}: {_source(i)}" for i in given.inputs)))
    shown.append(blocks.Paragraph(_factor(given)))
    if given.looked_at:
        shown += [blocks.Heading("Check against the poses kept out of the fit"),
                   blocks.Paragraph(_check(given))]  # fmt: skip
    if given.parameters is not None:
        shown += _behind(given.parameters)
    return [*shown, blocks.Heading("Not in the budget"), blocks.Bullets(OUTSIDE)]


def _source(i: Input) -> str:
    """Return where the figure of an input is from."""
    text = INPUTS[i.basis][1].format(*i.values)
    if i.basis not in (Basis.HELD_OUT, Basis.FITTED):
        return text
    outliers = ", ".join(str(row + 1) for row in i.values[1])
    without = f", without outliers (reading {outliers})" if outliers else ""
    beyond = "what is" if i.std else "nothing found"
    return f"{text}{without}: {beyond} beyond the lines above"


def _result(given: Budget) -> str:
    return (
        f"Along each axis the tool is within ± {mm(given.expanded)} of where the calibrated model "
        f"puts it (expanded uncertainty, k = 2, about {percent(given.coverage)}); in space, "
        f"95 % of the poses keep within {mm(given.expanded_length)} of their place. This holds "
        "over the workspace and the loads that were measured."
    )


def _table(given: Budget) -> blocks.Table:
    rows: list[list[blocks.Cell]] = [_row(i, given.combined) for i in given.inputs]
    rows.append(
        ["combined standard uncertainty", fine(given.combined), _freedom(given.freedom), ""]
    )
    rows.append(["expanded uncertainty, k\u00a0=\u00a02", fine(given.expanded), "", ""])
    heads = ("input", "standard uncertainty", "degrees of freedom", "share")
    return blocks.Table(heads, rows, (2.5, 1.3, 1.3, 1.5), (1, 2), sums=2)


def _row(i: Input, combined: float) -> list[blocks.Cell]:
    share = (i.std / combined) ** 2 if combined else 0.0
    return [
        INPUTS[i.basis][0], fine(i.std), _freedom(i.freedom),
        blocks.Bar(share, f"{share * 100:.0f} %"),
    ]  # fmt: skip


def _freedom(freedom: float) -> str:
    return f"{freedom:.0f}" if math.isfinite(freedom) else "∞"


def _factor(given: Budget) -> str:
    text = (
        "All inputs are of type A, from the readings of this session, with normal distributions "
        "and a sensitivity of 1. The instrument's noise is in the scatter from which they are "
        "made, and not counted again."
    )
    if math.isfinite(given.freedom):
        text += (
            f" Effective degrees of freedom (Welch and Satterthwaite): {given.freedom:.0f}; with "
            f"them k = 2 covers {given.coverage * 100:.1f} %, and 95.45 % would ask for "
            f"k = {given.needed_factor:.2f}."
        )
    return text


def _check(given: Budget) -> str:
    share = given.inside / given.looked_at
    text = (
        f"Of {given.looked_at} coordinates that the fit never saw, {given.inside} "
        f"({percent(share)}) are within ± {mm(given.bound)}: twice the combined uncertainty and "
        f"the noise of one reading together. {percent(given.coverage)} were to be expected"
    )
    if given.doubtful:
        return f"{text}; these are fewer than chance allows, so that the budget is too small."
    return f"{text}: they agree with the budget."


def _behind(given: Sensitivities) -> list[blocks.Block]:
    rows: list[list[blocks.Cell]] = [
        _parameter(s) for s in sorted(given.each, key=lambda s: -s.contribution)
    ]
    size = math.sqrt(abs(given.correlation))
    sign = "+" if given.correlation >= 0 else "−"
    rows.append(["correlations between them", "", "", f"{sign} {fine(size)}"])
    rows.append([blocks.Strong("together"), "", "", fine(given.combined)])
    heads = ("parameter", "standard uncertainty", "sensitivity", "contribution")
    note = (
        "Sensitivity is how far the tool moves along an axis, rms over the poses that judge the "
        "calibration. Parameters that replace each other have large contributions which their "
        "correlations take away again; contributions add in squares."
    )
    return [
        blocks.Heading("Behind “parameters of the model”"),
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
        fine(s.contribution),
    ]  # fmt: skip
