"""The short report of a session for the tool: where its tip is, from joint angles alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.bridge.calibration.report.facts import SessionFacts
from gapbridge.bridge.calibration.report.figures import fixed, mm
from gapbridge.bridge.calibration.report.sections.parameters_section import estimates_table
from gapbridge.bridge.calibration.report.sections.session_section import facts_blocks
from gapbridge.bridge.document.axes import Chart, named, scale
from gapbridge.bridge.document.blocks import (
    DOUBTFUL,
    GOOD,
    Badge,
    Block,
    Paragraph,
    Pictures,
    Tile,
    Tiles,
    Verdict,
)
from gapbridge.bridge.document.drawing import AFTER, BAD_DOT, BEFORE, Drawing
from gapbridge.bridge.document.section import Section
from gapbridge.bridge.report.names import sentence
from gapbridge.core.calibration.tool_session import ToolCalibration
from gapbridge.core.model import Model


@dataclass(frozen=True)
class ToolMaterial:
    """What a session for the tool found; ``nominal`` is what the cell had."""

    found: ToolCalibration
    session: SessionFacts
    nominal: Model | None


class ToolResult(Section[ToolMaterial]):
    """Where the tip is."""

    key, title = "result", "Result"

    def blocks(self, material: ToolMaterial) -> list[Block]:
        """Return the verdict, the large figures and what the cell had."""
        found = material.found
        badge = Badge("Found, see remarks", DOUBTFUL) if found.notes else Badge("Found", GOOD)
        wide = max((e.interval[1] - e.interval[0]) / 2 for e in found.estimates)
        tiles = Tiles((
            Tile("tool centre x, y, z, mm", _point(found.tcp),
                 f"± {mm(wide)} (95 %, the widest)"),
            Tile("tips apart before", mm(_rms(found.nominal_residual)), "rms, cell's tool"),
            Tile("tips apart after", mm(_rms(found.residual)), "rms, tool found"),
            Tile("noise of one touch", mm(found.noise), "1 sigma of one coordinate"),
        ))  # fmt: skip
        blocks: list[Block] = [Verdict(badge, sentence(found.verdict)), tiles]
        if material.nominal is not None:
            before = material.nominal.chain().tool_position
            text = f"The cell had the tool at {_point(before)} mm, in the axes of the flange."
            blocks.append(Paragraph(text))
        return blocks


def _point(values: object) -> str:
    return ", ".join(fixed(float(v) * 1e3, 2) for v in np.asarray(values))


def _rms(values: object) -> float:
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))


class ToolFacts(Section[ToolMaterial]):
    """Who, where, when, with what."""

    key, title = "session", "Session and instrument"

    def blocks(self, material: ToolMaterial) -> list[Block]:
        """Return the facts."""
        counts = [("touches", str(len(material.found.residual)))]
        return facts_blocks(material.session, counts, 1, material.found.notes)


class ToolEstimates(Section[ToolMaterial]):
    """The tool centre with its intervals."""

    key, title = "parameters", "What was found"
    about = "Flange axes; intervals of 95 %."

    def blocks(self, material: ToolMaterial) -> list[Block]:
        """Return the table and the touches."""
        found = material.found
        place = f"The fixed place is at {_point(found.point)} mm in the axes of the base."
        caption = (
            "How far each touch is from the fixed place: with the tool that the cell had, and with "
            "the one that was found. Red: down-weighted as outlier."
        )
        return [
            estimates_table(list(found.estimates), planned=False), Paragraph(place),
            Pictures((_touches(found),), caption),
        ]  # fmt: skip


def _touches(found: ToolCalibration) -> Drawing:
    labels = [str(i + 1) for i in range(len(found.residual))]
    both = [*np.abs(found.nominal_residual) * 1e3, *np.abs(found.residual) * 1e3]
    chart = Chart("Every touch", named("touch", labels), scale("mm", both), width=420)
    for i in range(len(labels)):
        chart.column(i - 0.2, float(abs(found.nominal_residual[i])) * 1e3, BEFORE, 0.36)
        colour = BAD_DOT if i in found.outliers else AFTER
        chart.column(i + 0.2, float(abs(found.residual[i])) * 1e3, colour, 0.36)
    chart.legend((("before", BEFORE), ("after", AFTER)))
    return chart.drawing


TOOL: tuple[Section[ToolMaterial], ...] = (ToolResult(), ToolFacts(), ToolEstimates())
