"""The report of a verification: whether the calibration is still valid, and what changed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.bridge.calibration.format import verdict_text
from gapbridge.bridge.calibration.report.data import SessionFacts
from gapbridge.bridge.calibration.report.sections.parameters_section import estimates_table
from gapbridge.bridge.calibration.report.sections.session_section import facts_blocks
from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.axes import Chart, named, scale
from gapbridge.bridge.document.drawing import AFTER, EDGE, Drawing
from gapbridge.bridge.document.notes import note_texts
from gapbridge.bridge.document.numbers import degrees, fixed, likelihood, mm
from gapbridge.bridge.report.labels import effect_title, parameter_title, sentence
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.verify import CandidateChange, Verification

STEPS_VALID = (
    "Nothing: use the cell as it is. Verify it again after some months, and after every collision, "
    "repair or change of the tool.",
)
STEPS_INVALID = (
    "Do not rely on this cell's correction: gapbridge disarm CELL.",
    "Inspect what the report names: loose screws, the tool and its load, the instrument's target.",
    "Then recalibrate: gapbridge calibrate CELL, or with --tool-only or --payload-only if only "
    "those have changed.",
)
BAND_FACTOR = 2.0  # predicted sigmas that a valid calibration's error rarely exceeds


@dataclass(frozen=True)
class VerificationData:
    """A verification with the facts of its session; ``readings`` give the joint angles."""

    verification: Verification
    session: SessionFacts
    readings: Readings | None = None


def result(data: VerificationData) -> list[blocks.Block]:
    """Return the verdict, the next steps, the main figures and the criterion."""
    v = data.verification
    badge = (
        blocks.Badge("Still holds", blocks.GOOD)
        if v.holds
        else blocks.Badge("No longer holds", blocks.BAD)
    )
    predicted = float(np.sqrt(np.mean(v.predicted**2)))
    tiles = blocks.Tiles((
        blocks.Tile("error now, rms", mm(v.errors.rms), f"at most {mm(v.errors.max)}"),
        blocks.Tile("predicted, rms", mm(predicted), "uncertainty, arm and instrument"),
        blocks.Tile("error over prediction", f"{v.ratio:.2f}", "about 1 is as predicted"),
        blocks.Tile("chance", likelihood(v.chance), "of this ratio, if still valid"),
    ))  # fmt: skip
    text = (
        "A few poses were measured and compared with the prediction of the calibration. It counts "
        "as no longer valid if errors of this size would occur by chance in less than one of "
        "1000 verifications."
    )
    steps = STEPS_VALID if v.holds else STEPS_INVALID
    return [
        blocks.Verdict(badge, sentence(verdict_text(v))), blocks.Heading("What to do now"),
        blocks.Bullets(steps), tiles, blocks.Paragraph(text, "note"),
    ]  # fmt: skip


def facts(data: VerificationData) -> list[blocks.Block]:
    """Return the facts of a verification session."""
    v = data.verification
    counts = [("readings", str(len(v.errors.rows)))]
    return facts_blocks(data.session, counts, len(v.stations), note_texts(v.notes, parameter_title))


def poses(data: VerificationData) -> list[blocks.Block]:
    """Return a chart and a table of the errors against twice their prediction."""
    v, readings = data.verification, data.readings
    rows: list[list[blocks.Cell]] = []
    for i, row in enumerate(v.errors.rows):
        q = "–" if readings is None else degrees(readings.q[row])
        within = v.errors.norm[i] <= BAND_FACTOR * v.predicted[i]
        rows.append([
            str(int(row) + 1), q, ",  ".join(fixed(x * 1e3, 3) for x in v.errors.vector[i]),
            mm(float(v.errors.norm[i])), mm(float(v.predicted[i])),
            blocks.Badge("within", blocks.GOOD) if within else blocks.Badge("beyond", blocks.BAD),
        ])  # fmt: skip
    heads = ("no.", "joint angles, degrees", "error along the axes, mm", "error",
             "predicted, 1 sigma", "twice the prediction")  # fmt: skip
    table = blocks.Table(heads, rows, (0.4, 3, 1.9, 0.9, 1, 1), (2, 3, 4))
    return [blocks.Pictures((_picture(v),)), table]


def _picture(v: Verification) -> Drawing:
    labels = [str(int(row) + 1) for row in v.errors.rows]
    step = max(1, len(labels) // 20)
    labels = [name if i % step == 0 else "" for i, name in enumerate(labels)]
    values = [*v.errors.norm * 1e3, *BAND_FACTOR * v.predicted * 1e3]
    chart = Chart("Error and prediction", named("reading", labels), scale("mm", values), width=560)
    for i, (error, predicted) in enumerate(zip(v.errors.norm, v.predicted, strict=True)):
        chart.column(i, float(error) * 1e3, AFTER, 0.55)
        most = BAND_FACTOR * float(predicted) * 1e3
        chart.line([i - 0.4, i + 0.4], [most, most], EDGE, width=2.2)
    chart.legend((("error", AFTER), ("twice the prediction", EDGE)))
    return chart.drawing


def changes(data: VerificationData) -> list[blocks.Block]:
    """Return the possible changes since the calibration; nothing if it is still valid."""
    v = data.verification
    if v.holds:
        return []
    if v.moved is None:
        return [blocks.Paragraph(
            "No single change (tool, load, one joint's zero, instrument, one bad reading) "
            "explains the errors. Recalibrate."
        )]  # fmt: skip
    shown: list[blocks.Block] = [blocks.Paragraph(f"Best explanation: {change_title(v.moved)}.")]
    if v.moved.estimates:
        shown.append(estimates_table(list(v.moved.estimates), planned=False))
    if v.alternatives:
        rows = [[change_title(s), likelihood(s.chance)] for s in v.alternatives]
        shown += [
            blocks.Heading("Explanations that fit nearly as well"),
            blocks.Table(("change", "chance of the residual"), rows, (3, 1), (1,)),
        ]
    return shown


def change_title(suspect: CandidateChange) -> str:
    """Return the name of a possible change."""
    if suspect.reading is not None:
        return f"reading {suspect.reading} alone is wrong"
    if not suspect.effect:
        return "the instrument has moved"
    if suspect.joint is None:
        return effect_title(suspect.effect)
    return f"another {parameter_title(suspect.name)}"


VERIFICATION: tuple[blocks.Section[VerificationData], ...] = (
    blocks.Section("result", "Result", result),
    blocks.Section("session", "Session and instrument", facts),
    blocks.Section("poses", "Every reading", poses,
            "Error of each reading, and twice the calibration's prediction of it."),
    blocks.Section("moved", "What may have changed", changes),
)  # fmt: skip
