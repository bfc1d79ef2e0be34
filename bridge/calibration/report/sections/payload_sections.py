"""The short report of a session with the flange sensor: load and sensor zero."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.bridge.calibration.report.facts import SessionFacts
from gapbridge.bridge.calibration.report.figures import fixed
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
    Table,
    Tile,
    Tiles,
    Verdict,
)
from gapbridge.bridge.document.drawing import AFTER, BAD_DOT, Drawing
from gapbridge.bridge.document.section import Section
from gapbridge.bridge.report.names import sentence
from gapbridge.core.calibration.payload_session import PayloadCalibration
from gapbridge.core.model import Model


@dataclass(frozen=True)
class PayloadMaterial:
    """What a session with the flange sensor found; ``nominal`` is what the cell had."""

    found: PayloadCalibration
    session: SessionFacts
    nominal: Model | None


class PayloadResult(Section[PayloadMaterial]):
    """Mass and centre of gravity."""

    key, title = "result", "Result"

    def blocks(self, material: PayloadMaterial) -> list[Block]:
        """Return the verdict, the large figures and what the cell had."""
        found = material.found
        badge = Badge("Found, see remarks", DOUBTFUL) if found.notes else Badge("Found", GOOD)
        mass, *cog = (e for e in found.estimates[:4])
        wide = max((e.interval[1] - e.interval[0]) / 2 for e in cog)
        tiles = Tiles((
            Tile("mass", f"{fixed(mass.value, 3)} kg",
                 f"± {fixed((mass.interval[1] - mass.interval[0]) / 2, 3)} kg (95 %)"),
            Tile("centre of gravity x, y, z, mm", _point(found.cog),
                 f"± {fixed(wide * 1e3, 1)} mm (95 %, the widest)"),
            Tile("sensor zero of force, N", _point(found.bias[:3], 1.0, 2), "along x, y, z"),
            Tile("sensor zero of torque, Nm", _point(found.bias[3:], 1.0, 3), "about x, y, z"),
        ))  # fmt: skip
        blocks: list[Block] = [Verdict(badge, sentence(found.verdict)), tiles]
        if material.nominal is not None:
            nominal = material.nominal
            text = (
                f"The cell had {fixed(nominal.payload_mass, 3)} kg at "
                f"{_point(nominal.payload_cog)} mm from the flange."
            )
            blocks.append(Paragraph(text))
        return blocks


def _point(values: object, factor: float = 1e3, decimals: int = 1) -> str:
    return ", ".join(fixed(float(v) * factor, decimals) for v in np.asarray(values))


class PayloadFacts(Section[PayloadMaterial]):
    """Who, where, when, with what."""

    key, title = "session", "Session and instrument"

    def blocks(self, material: PayloadMaterial) -> list[Block]:
        """Return the facts."""
        counts = [("orientations", str(len(material.found.residual)))]
        return facts_blocks(material.session, counts, 1, material.found.notes)


class PayloadEstimates(Section[PayloadMaterial]):
    """All ten numbers."""

    key, title = "parameters", "What was found"
    about = "Flange axes; intervals of 95 %."

    def blocks(self, material: PayloadMaterial) -> list[Block]:
        """Return the table."""
        shown = [e for e in material.found.estimates if e.shown]
        return [estimates_table(shown, planned=False)]


class PayloadRemainder(Section[PayloadMaterial]):
    """What the sensor read beyond load and zero."""

    key, title = "remainder", "The residual"
    about = "Reading minus load and sensor zero, orientation by orientation."

    def blocks(self, material: PayloadMaterial) -> list[Block]:
        """Return the remainder as pictures, against the noise that was found."""
        found = material.found
        drawings = (
            _remainder("Residual force", "N", found, slice(0, 3)),
            _remainder("Residual torque", "Nm", found, slice(3, 6)),
        )
        force, torque = found.noise
        rows = [["force", f"{fixed(force, 3)} N"], ["torque", f"{fixed(torque, 4)} Nm"]]
        caption = "Length of the residual; red: down-weighted as outlier."
        return [Pictures(drawings, caption),
                Table(("noise of one axis, 1 sigma", "found"), rows, (2, 1), (1,))]  # fmt: skip


def _remainder(title: str, unit: str, found: PayloadCalibration, part: slice) -> Drawing:
    norm = np.linalg.norm(found.residual[:, part], axis=1)
    labels = [str(i + 1) for i in range(len(norm))]
    chart = Chart(title, named("orientation", labels), scale(unit, [*norm]))
    for i, value in enumerate(norm):
        chart.column(i, float(value), BAD_DOT if i in found.outliers else AFTER, 0.6)
    return chart.drawing


PAYLOAD: tuple[Section[PayloadMaterial], ...] = (
    PayloadResult(), PayloadFacts(), PayloadEstimates(), PayloadRemainder(),
)  # fmt: skip
