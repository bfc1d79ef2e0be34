"""Parameters with intervals, what is not identifiable, and the diagnosis of the residual."""

from __future__ import annotations

from gapbridge.bridge.calibration.report.data import CalibrationData
from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.findings import finding_text
from gapbridge.bridge.document.notes import note_text
from gapbridge.bridge.document.numbers import (
    decimals_of,
    degrees,
    estimate_texts,
    fixed,
    plain,
    unit_of,
)
from gapbridge.bridge.report.answer import one_line, sentences
from gapbridge.bridge.report.labels import CHANNELS, effect_title, listed, parameter_title, sentence
from gapbridge.bridge.report.material import chosen_channel
from gapbridge.core.calibration.result import Estimate
from gapbridge.core.diagnosis.channel_diagnosis import Verdict
from gapbridge.core.diagnosis.diagnosis import Diagnosis

MAX_MEASUREMENTS = 8  # of those proposed


def parameters(data: CalibrationData) -> list[blocks.Block]:
    """Return the table of parameters, and those that the readings do not determine."""
    c = data.calibration
    shown = [e for e in c.estimates if e.shown]
    # combinations name most of the parameters that are not shown
    named = {note.values[0] for note in c.combinations}
    hidden = [e.name for e in c.estimates if not e.shown and e.name not in named]
    planned = any(e.expected_std is not None for e in shown)
    content: list[blocks.Block] = [estimates_table(shown, planned=planned)]
    if any(e.on_bound for e in shown):
        text = "* is at its physical bound."
        content.append(blocks.Paragraph(text, "note"))
    if c.combinations or hidden:
        content.append(blocks.Heading("What these readings cannot determine"))
        items = [note_text(note, parameter_title) for note in c.combinations]
        items += [
            f"{parameter_title(name)}: not identifiable from these readings; kept near its prior"
            for name in hidden
        ]
        content.append(blocks.Bullets(tuple(items)))
    return content


def estimates_table(shown: list[Estimate], *, planned: bool) -> blocks.Table:
    """Return values with intervals; ``planned``: with the sigma that the plan predicted."""
    heads: tuple[str, ...]
    if not planned:
        heads = ("parameter", "value", "95 % interval", "1 sigma", "unit")
        return blocks.Table(heads, [_row(e) for e in shown], (3.2, 1, 1.8, 1, 0.9), (1, 2, 3))
    heads = ("parameter", "value", "95 % interval", "1 sigma", "1 sigma, as planned", "unit")
    rows = [[*_row(e)[:4], _planned(e), _row(e)[4]] for e in shown]
    return blocks.Table(heads, rows, (3.2, 1, 1.8, 0.9, 1.1, 0.9), (1, 2, 3, 4))


def _row(e: Estimate) -> list[blocks.Cell]:
    value, interval, std, unit = estimate_texts(e)
    return [parameter_title(e.name) + (" *" if e.on_bound else ""), value, interval, std, unit]


def _planned(e: Estimate) -> str:
    if e.expected_std is None:
        return "–"
    _, factor = unit_of(e.unit)
    return fixed(e.expected_std * factor, decimals_of(e.std * factor))


def residual(data: CalibrationData) -> list[blocks.Block]:
    """Return the diagnosis of the residual and, if incomplete, the next measurements."""
    c = data.calibration
    if c.diagnosis is None:
        text = "The residual of these readings cannot be diagnosed."
        return [blocks.Verdict(blocks.Badge("Not examined", blocks.QUIET), text)]
    main = chosen_channel(c.diagnosis)
    content: list[blocks.Block] = [
        blocks.Verdict(data.completeness, sentence(note_text(c.remaining, parameter_title)))
    ]
    if not c.missing_effects and (c.complete or c.diagnosis.verdict is not Verdict.NO_GAP):
        content.append(blocks.Paragraph(" ".join(sentences(main))))
    others = [ch for ch in c.diagnosis.channels if ch is not main]
    content += [blocks.Paragraph(f"{CHANNELS[ch.channel]}: {one_line(ch)}") for ch in others]
    if c.diagnosis.findings:
        content.append(
            blocks.Bullets(
                tuple(
                    sentence(finding_text(f, rows=False, title=parameter_title))
                    for f in c.diagnosis.findings
                )
            )
        )
    return [*content, *([] if c.complete else _next_measurements(c.diagnosis))]


def _next_measurements(diagnosis: Diagnosis) -> list[blocks.Block]:
    if not diagnosis.next_measurements:
        return []
    rows = [
        [str(i), degrees(m.q), f"{plain(m.payload)} kg",
         listed([effect_title(name) for name in m.separates], "or")]
        for i, m in enumerate(diagnosis.next_measurements[:MAX_MEASUREMENTS], start=1)
    ]  # fmt: skip
    heads = ("", "joint angles, degrees", "load", "distinguishes")
    return [
        blocks.Heading("What to measure next"),
        blocks.Table(heads, rows, (0.3, 2.6, 0.7, 2.4), (2,)),
    ]
