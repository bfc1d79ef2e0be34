"""The residual: what the diagnosis says of it."""

from __future__ import annotations

from gapbridge.bridge.calibration.report.figures import degrees
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.document.axes import plain
from gapbridge.bridge.document.blocks import (
    DOUBTFUL,
    GOOD,
    QUIET,
    Badge,
    Block,
    Bullets,
    Heading,
    Paragraph,
    Table,
    Verdict,
)
from gapbridge.bridge.document.findings import finding_text
from gapbridge.bridge.report.answer import one_line, sentences
from gapbridge.bridge.report.labels import CHANNELS, effect_title, listed
from gapbridge.bridge.report.material import chosen_channel
from gapbridge.bridge.report.names import sentence
from gapbridge.core.diagnosis.diagnosis import Diagnosis

SHOWN = 8  # measurements proposed


def residual(material: Material) -> list[Block]:
    """Return the verdict, what was found, and what would settle it."""
    c = material.calibration
    if c.diagnosis is None:
        text = "These readings do not allow to examine the residual."
        return [Verdict(Badge("Not examined", QUIET), text)]
    badge = Badge("Complete", GOOD) if c.complete else Badge("Not complete", DOUBTFUL)
    main = chosen_channel(c.diagnosis)
    blocks: list[Block] = [Verdict(badge, sentence(c.remaining))]
    if not c.missing_effects and (c.complete or c.diagnosis.verdict != "no_gap"):
        blocks.append(Paragraph(" ".join(sentences(main))))
    others = [ch for ch in c.diagnosis.channels if ch is not main]
    blocks += [Paragraph(f"{CHANNELS[ch.channel]}: {one_line(ch)}") for ch in others]
    if c.diagnosis.findings:
        blocks.append(
            Bullets(tuple(sentence(finding_text(f, rows=False)) for f in c.diagnosis.findings))
        )
    return [*blocks, *([] if c.complete else _next(c.diagnosis))]


def _next(diagnosis: Diagnosis) -> list[Block]:
    if not diagnosis.next_measurements:
        return []
    rows = [
        [str(i), degrees(m.q), f"{plain(m.payload)} kg",
         listed([effect_title(name) for name in m.separates], "or")]
        for i, m in enumerate(diagnosis.next_measurements[:SHOWN], start=1)
    ]  # fmt: skip
    heads = ("", "joint angles, degrees", "load", "would settle")
    return [Heading("What to measure next"), Table(heads, rows, (0.3, 2.6, 0.7, 2.4), (2,))]
