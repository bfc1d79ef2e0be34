"""Data quality: findings, outliers, rows used, and what could not be seen."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.report.fragment import bullets, heading, paragraph, table
from gapbridge.bridge.report.material import Material, own_coordinates, per_sample
from gapbridge.bridge.report.words import CHANNELS, told
from gapbridge.core.diagnosis.diagnosis import ChannelDiagnosis
from gapbridge.core.log.log import Log

WILD = 20  # outliers listed a channel


def section(material: Material) -> str:
    """Return rows used, findings, outliers, channels that the log does not show."""
    diagnosis = material.diagnosis
    rows = [
        [CHANNELS[c.channel], str(len(material.log)), str(c.samples),
         str(int((~c.selection.kept).sum())),
         str(len(np.unique(c.selection.observation.groups)))]
        for c in diagnosis.channels
    ]  # fmt: skip
    parts = [
        table(("channel", "rows in the log", "samples used", "excluded as outliers",
               "different poses or stretches of time"), rows),
    ]  # fmt: skip
    parts.append(heading("Findings"))
    parts.append(bullets(diagnosis.findings) or paragraph("Nothing odd was found in the log."))
    parts += [_wild(c, material.log) for c in diagnosis.channels]
    if diagnosis.not_observable:
        parts.append(heading("What this log cannot show"))
        parts.append(table(
            ("channel", "columns it would need"),
            [[CHANNELS.get(h.channel, h.channel), ", ".join(h.needs)]
             for h in diagnosis.not_observable],
        ))  # fmt: skip
    return "".join(parts)


def _wild(channel: ChannelDiagnosis, log: Log) -> str:
    wild = np.flatnonzero(~channel.selection.kept)
    if not len(wild):
        return ""
    size = per_sample(channel.remaining, own_coordinates(channel))
    worst = wild[np.argsort(-size[wild])][:WILD]
    rows = [
        [str(log.line(channel.selection.observation.rows[i])), told(float(size[i]),
         channel.unit)] for i in worst
    ]  # fmt: skip
    more = f" The {WILD} largest of {len(wild)}:" if len(wild) > WILD else ""
    return heading(f"Outliers: {CHANNELS[channel.channel]}") + paragraph(
        f"They fit nothing around them and were excluded before any effect was judged.{more}"
    ) + table(("line of the file", "distance from the model"), rows)  # fmt: skip
