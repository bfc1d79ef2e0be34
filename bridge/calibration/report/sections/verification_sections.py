"""The short report of a verification: whether the calibration still holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.bridge.calibration.format import verdict_text
from gapbridge.bridge.calibration.report.facts import SessionFacts
from gapbridge.bridge.calibration.report.figures import degrees, mm
from gapbridge.bridge.calibration.report.sections.parameters_section import estimates_table
from gapbridge.bridge.calibration.report.sections.session_section import facts_blocks
from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.axes import Chart, named, scale
from gapbridge.bridge.document.drawing import AFTER, EDGE, Drawing
from gapbridge.bridge.document.notes import note_texts
from gapbridge.bridge.report.labels import (
    effect_title,
    fixed,
    likelihood,
    parameter_title,
    sentence,
)
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.verify import CandidateChange, Verification

HOLDS = (
    "Nothing: use the cell as it is. Check it again after some months, and after every collision, "
    "repair or change of the tool.",
)
BROKEN = (
    "Do not rely on this cell's correction: gapbridge disarm CELL.",
    "Look at what the report names: loose screws, the tool and its load, the instrument's target.",
    "Then measure it again: gapbridge calibrate CELL, or --tool-only or --payload-only where only "
    "those have changed.",
)
TWICE = 2.0  # predicted sigmas that an error hardly exceeds


@dataclass(frozen=True)
class VerificationMaterial:
    """A verification with the facts of its session; readings give the poses where given."""

    verification: Verification
    session: SessionFacts
    readings: Readings | None = None


def holds(material: VerificationMaterial) -> list[blocks.Block]:
    """Return the verdict, the large figures and how it was judged."""
    v = material.verification
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
        blocks.Tile("chance", likelihood(v.chance), "of so much, if it still holds"),
    ))  # fmt: skip
    text = (
        "A few poses were measured again and compared with what the calibration said they "
        "would be. It counts as broken where so large an error would come by chance less than "
        "once in a thousand."
    )
    steps = HOLDS if v.holds else BROKEN
    return [
        blocks.Verdict(badge, sentence(verdict_text(v))), blocks.Heading("What to do now"),
        blocks.Bullets(steps), tiles, blocks.Paragraph(text, "note"),
    ]  # fmt: skip


def facts(material: VerificationMaterial) -> list[blocks.Block]:
    """Return the facts."""
    v = material.verification
    counts = [("readings", str(len(v.errors.rows)))]
    return facts_blocks(
        material.session, counts, len(v.stations), note_texts(v.notes, parameter_title)
    )


def poses(material: VerificationMaterial) -> list[blocks.Block]:
    """Return a picture and a table."""
    v, readings = material.verification, material.readings
    rows: list[list[blocks.Cell]] = []
    for i, row in enumerate(v.errors.rows):
        q = "–" if readings is None else degrees(readings.q[row])
        within = v.errors.norm[i] <= TWICE * v.predicted[i]
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
    values = [*v.errors.norm * 1e3, *TWICE * v.predicted * 1e3]
    chart = Chart("Error and prediction", named("reading", labels), scale("mm", values), width=560)
    for i, (error, predicted) in enumerate(zip(v.errors.norm, v.predicted, strict=True)):
        chart.column(i, float(error) * 1e3, AFTER, 0.55)
        most = TWICE * float(predicted) * 1e3
        chart.line([i - 0.4, i + 0.4], [most, most], EDGE, width=2.2)
    chart.legend((("error", AFTER), ("twice the prediction", EDGE)))
    return chart.drawing


def moved(material: VerificationMaterial) -> list[blocks.Block]:
    """Return the suspects; nothing where the calibration holds."""
    v = material.verification
    if v.holds:
        return []
    if v.moved is None:
        return [blocks.Paragraph(
            "No single change (tool, load, one joint's zero, instrument, one bad reading) "
            "explains the errors. Recalibrate."
        )]  # fmt: skip
    shown: list[blocks.Block] = [
        blocks.Paragraph(f"What explains it best: {suspect_title(v.moved)}.")
    ]
    if v.moved.estimates:
        shown.append(estimates_table(list(v.moved.estimates), planned=False))
    if v.alternatives:
        rows = [[suspect_title(s), likelihood(s.chance)] for s in v.alternatives]
        shown += [
            blocks.Heading("What explains it nearly as well"),
            blocks.Table(("change", "chance of what is left"), rows, (3, 1), (1,)),
        ]
    return shown


def suspect_title(suspect: CandidateChange) -> str:
    """Return what may have moved, for people."""
    if suspect.reading is not None:
        return f"reading {suspect.reading} alone is wrong"
    if not suspect.effect:
        return "the instrument stands elsewhere"
    if suspect.joint is None:
        return effect_title(suspect.effect)
    return f"another {parameter_title(suspect.name)}"


VERIFICATION: tuple[blocks.Section[VerificationMaterial], ...] = (
    blocks.Section("result", "Result", holds),
    blocks.Section("session", "Session and instrument", facts),
    blocks.Section("poses", "Every reading", poses,
            "Error of each reading, and twice the calibration's prediction of it."),
    blocks.Section("moved", "What may have moved", moved),
)  # fmt: skip
