"""The report of a diagnosis: one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.findings import finding_text
from gapbridge.bridge.document.html import html
from gapbridge.bridge.document.numbers import with_unit
from gapbridge.bridge.document.provenance import origin_blocks, origin_line
from gapbridge.bridge.report.answer import answer
from gapbridge.bridge.report.gap_location import effect_tables, gap_location
from gapbridge.bridge.report.gap_reduction import gap_reduction
from gapbridge.bridge.report.labels import CHANNELS
from gapbridge.bridge.report.material import Material, per_sample
from gapbridge.bridge.report.parameters import parameters
from gapbridge.bridge.report.slips import slip_section
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis
from gapbridge.core.diagnosis.diagnosis import Diagnosis
from gapbridge.core.diagnosis.noise_floor import own_coordinates
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model

LISTED = 20  # most outliers listed per channel


def report_text(
    diagnosis: Diagnosis, cell_name: str, log: Log, model: Model,
    origin: Mapping[str, Any] | None = None,
) -> str:  # fmt: skip
    """Return the report as HTML.

    ``model`` is the cell's model as it was diagnosed, ``origin`` the result's provenance.
    """
    return html(document(Material(diagnosis, cell_name, log, model, origin or {})))


def document(material: Material) -> blocks.Document:
    """Return the report as blocks."""
    name, arm = _cell_title(material.cell_name), material.model.arm
    kind = "Arm of DH rows" if arm.name == "dh" else f"Arm {arm.name}"
    log = f"log {Path(material.log.path).name}, {len(material.log)} rows"
    return blocks.Document(
        f"{name}: the robot against its model",
        f"{kind}, {arm.n} joints · {log} · {origin_line(material.origin)}",
        blocks.parts(SECTIONS, material),
        f"Gap between model and robot, {name} · {origin_line(material.origin)}",
    )


def _cell_title(name: str) -> str:
    """Return a cell's name; for a path to a cell file, the name of the file."""
    return Path(name).stem if name.endswith((".yaml", ".yml")) else name


def data_quality(material: Material) -> list[blocks.Block]:
    """Return rows used, findings, outliers, channels that are not observable, provenance."""
    diagnosis = material.diagnosis
    rows = [
        [CHANNELS[c.channel], str(len(material.log)), str(c.samples),
         str(len(c.outliers)),
         str(len(np.unique(c.selection.observation.groups)))]
        for c in diagnosis.channels
    ]  # fmt: skip
    heads = ("channel", "rows in the log", "samples used", "excluded as outliers",
             "different poses or stretches of time")  # fmt: skip
    shown: list[blocks.Block] = [blocks.Table(heads, rows), blocks.Heading("Findings")]
    shown.append(
        blocks.Bullets(tuple(finding_text(f) for f in diagnosis.findings)) if diagnosis.findings
        else blocks.Paragraph("The checks of the log found no anomaly.")
    )  # fmt: skip
    for channel in diagnosis.channels:
        shown += _outliers(channel, material.log)
    if diagnosis.not_observable:
        missing = [
            [CHANNELS.get(c.channel, c.channel), ", ".join(c.needs)]
            for c in diagnosis.not_observable
        ]
        shown += [
            blocks.Heading("What this log cannot show"),
            blocks.Table(("channel", "columns it would need"), missing),
        ]
    return shown + origin_blocks(material.origin)


def _outliers(channel: ChannelDiagnosis, log: Log) -> list[blocks.Block]:
    outliers = np.flatnonzero(~channel.selection.kept)
    if not len(outliers):
        return []
    size = per_sample(channel.remaining, own_coordinates(channel.selection.observation))
    worst = outliers[np.argsort(-size[outliers])][:LISTED]
    rows = [
        [str(log.line(channel.selection.observation.rows[i])), with_unit(float(size[i]),
         channel.unit)] for i in worst
    ]  # fmt: skip
    count = len(channel.outliers)
    more = f" The {len(worst)} largest of {count}:" if count > len(worst) else ""
    return [
        blocks.Heading(f"Outliers: {CHANNELS[channel.channel]}"),
        blocks.Paragraph(
            f"They disagree with their neighbours and were excluded from the fit of effects.{more}"
        ),
        blocks.Table(("line of the file", "distance from the model"), rows),
    ]


SECTIONS: tuple[blocks.Section[Material], ...] = (
    blocks.Section("answer", "The answer", answer),
    blocks.Section("slips", "Before and after each slip", slip_section,
            "The gap of each part of the log between the slips."),
    blocks.Section("where", "Where the gap lies", gap_location,
            "Which joints and axes it comes from, and what it depends on."),
    blocks.Section("which", "Which effect causes it", effect_tables,
            "Every effect that was tried, with the evidence for and against."),
    blocks.Section("how_far", "How far it shrinks", gap_reduction,
            "All figures are of held-out measurements."),
    blocks.Section("parameters", "Parameters and next measurements", parameters,
            "What is added to the model, with intervals, and which measurements would add most."),
    blocks.Section("data_quality", "Data quality", data_quality,
            "What was used, what was excluded, what is not observable."),
)  # fmt: skip
