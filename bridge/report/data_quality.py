"""Data quality: findings, outliers, rows used, what could not be seen, and where it comes from."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.document.blocks import Block, Bullets, Heading, Paragraph, Table
from gapbridge.bridge.document.findings import finding_text
from gapbridge.bridge.document.provenance import origin_blocks
from gapbridge.bridge.report.labels import CHANNELS, with_unit
from gapbridge.bridge.report.material import Material, own_coordinates, per_sample
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis
from gapbridge.core.log.log import Log

LISTED = 20  # outliers listed a channel


def data_quality(material: Material) -> list[Block]:
    """Return rows used, findings, outliers, channels that the log does not show, origin."""
    diagnosis = material.diagnosis
    rows = [
        [CHANNELS[c.channel], str(len(material.log)), str(c.samples),
         str(len(c.outliers)),
         str(len(np.unique(c.selection.observation.groups)))]
        for c in diagnosis.channels
    ]  # fmt: skip
    heads = ("channel", "rows in the log", "samples used", "excluded as outliers",
             "different poses or stretches of time")  # fmt: skip
    blocks: list[Block] = [Table(heads, rows), Heading("Findings")]
    blocks.append(
        Bullets(tuple(finding_text(f) for f in diagnosis.findings)) if diagnosis.findings
        else Paragraph("No check of the log found anything odd.")
    )  # fmt: skip
    for channel in diagnosis.channels:
        blocks += _outliers(channel, material.log)
    if diagnosis.not_observable:
        hidden = [
            [CHANNELS.get(h.channel, h.channel), ", ".join(h.needs)]
            for h in diagnosis.not_observable
        ]
        blocks += [
            Heading("What this log cannot show"),
            Table(("channel", "columns it would need"), hidden),
        ]
    return blocks + origin_blocks(material.origin)


def _outliers(channel: ChannelDiagnosis, log: Log) -> list[Block]:
    outliers = np.flatnonzero(~channel.selection.kept)
    if not len(outliers):
        return []
    size = per_sample(channel.remaining, own_coordinates(channel))
    worst = outliers[np.argsort(-size[outliers])][:LISTED]
    rows = [
        [str(log.line(channel.selection.observation.rows[i])), with_unit(float(size[i]),
         channel.unit)] for i in worst
    ]  # fmt: skip
    count = len(channel.outliers)
    more = f" The {len(worst)} largest of {count}:" if count > len(worst) else ""
    return [
        Heading(f"Outliers: {CHANNELS[channel.channel]}"),
        Paragraph(
            f"They fit nothing around them and were excluded before any effect was judged.{more}"
        ),
        Table(("line of the file", "distance from the model"), rows),
    ]
