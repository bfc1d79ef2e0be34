"""The short reports: a session with the flange sensor, and one for the tool."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from gapbridge.bridge.calibration.report.facts import SessionFacts
from gapbridge.bridge.calibration.report.figures import mm
from gapbridge.bridge.calibration.report.sections.parameters_section import estimates_table
from gapbridge.bridge.calibration.report.sections.session_section import facts_blocks
from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.axes import Chart, named, scale
from gapbridge.bridge.document.drawing import AFTER, BAD_DOT, BEFORE, Drawing
from gapbridge.bridge.document.notes import note_texts, short_text
from gapbridge.bridge.report.labels import fixed, parameter_title, sentence
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.payload_session import PayloadCalibration
from gapbridge.core.calibration.tool_session import ToolCalibration
from gapbridge.core.model import Model

F = TypeVar("F", bound=PayloadCalibration | ToolCalibration)


@dataclass(frozen=True)
class ShortMaterial(Generic[F]):
    """What a short session found; ``nominal`` is the model as the cell had it."""

    found: F
    session: SessionFacts
    nominal: Model | None = None


def _result(
    found: PayloadCalibration | ToolCalibration, tiles: tuple[blocks.Tile, ...], before: str
) -> list[blocks.Block]:
    """Return the verdict, what to do, the large figures, and what the cell had."""
    badge = (
        blocks.Badge("Found, see remarks", blocks.DOUBTFUL)
        if found.notes
        else blocks.Badge("Found", blocks.GOOD)
    )
    return [
        blocks.Verdict(badge, sentence(short_text(found))),
        blocks.Heading("What to do now"), blocks.Bullets(tuple(_next_steps(found))),
        blocks.Tiles(tiles),
        *([blocks.Paragraph(before)] if before else []),
    ]  # fmt: skip


def _next_steps(found: PayloadCalibration | ToolCalibration) -> list[str]:
    """Return what the user does next, most urgent first."""
    what = "payload and centre of gravity" if isinstance(found, PayloadCalibration) else "TCP"
    first = ["See the remarks under “Session and instrument”, and measure again what they name."]
    return [
        *(first if found.notes else []),
        f"Set the same {what} in the robot controller; gapbridge check CELL --live compares both.",
        "Watch the new cell first (gapbridge run CELL --observe), then let it write "
        "(gapbridge run CELL --arm).",
        "Measure again after every collision and every change of the tool.",
    ]


def _point(values: Sequence[float] | Array, factor: float = 1e3, decimals: int = 1) -> str:
    return ", ".join(fixed(float(v) * factor, decimals) for v in np.asarray(values))


def _bars(
    title: str, names: str, unit: str, series: Sequence[tuple[Array, str]],
    outliers: Collection[int],
) -> Chart:  # fmt: skip
    """Return a chart of magnitudes, one group of columns an entry; the last series' outliers red.

    ``series`` are magnitudes in ``unit`` with their colours.
    """
    count = len(series[0][0])
    every = [float(v) for values, _ in series for v in values]
    labels = [str(i + 1) for i in range(count)]
    chart = Chart(
        title, named(names, labels), scale(unit, every), width=340 + 80 * (len(series) - 1)
    )
    width = 0.72 / len(series)
    for k, (values, colour) in enumerate(series):
        shift = (k - (len(series) - 1) / 2) * (width + 0.04)
        for i, value in enumerate(values):
            marked = k == len(series) - 1 and i in outliers
            chart.column(i + shift, float(value), BAD_DOT if marked else colour, width)
    return chart


def payload_result(material: ShortMaterial[PayloadCalibration]) -> list[blocks.Block]:
    """Return mass, centre of gravity and the sensor's zero."""
    found, nominal = material.found, material.nominal
    mass, *cog = (e for e in found.estimates[:4])
    wide = max((e.interval[1] - e.interval[0]) / 2 for e in cog)
    tiles = (
        blocks.Tile("mass", f"{fixed(mass.value, 3)} kg",
             f"± {fixed((mass.interval[1] - mass.interval[0]) / 2, 3)} kg (95 %)"),
        blocks.Tile("centre of gravity x, y, z, mm", _point(found.cog),
             f"± {fixed(wide * 1e3, 1)} mm (95 %, the widest)"),
        blocks.Tile("sensor zero of force, N", _point(found.bias[:3], 1.0, 2), "along x, y, z"),
        blocks.Tile("sensor zero of torque, Nm", _point(found.bias[3:], 1.0, 3), "about x, y, z"),
    )  # fmt: skip
    before = "" if nominal is None else (
        f"The cell had {fixed(nominal.payload_mass, 3)} kg at "
        f"{_point(nominal.payload_cog)} mm from the flange."
    )  # fmt: skip
    return _result(found, tiles, before)


def short_facts(material: ShortMaterial[F]) -> list[blocks.Block]:
    """Return who, where, when, with what."""
    found = material.found
    what = "orientations" if isinstance(found, PayloadCalibration) else "touches"
    counts = [(what, str(len(found.residual)))]
    return facts_blocks(material.session, counts, 1, note_texts(found.notes, parameter_title))


def payload_parameters(material: ShortMaterial[PayloadCalibration]) -> list[blocks.Block]:
    """Return all ten numbers."""
    return [estimates_table([e for e in material.found.estimates if e.shown], planned=False)]


def payload_residual(material: ShortMaterial[PayloadCalibration]) -> list[blocks.Block]:
    """Return what the sensor read beyond load and zero, against the noise that was found."""
    found = material.found
    drawings = [
        _bars(title, "orientation", unit,
              [(np.linalg.norm(found.residual[:, part], axis=1), AFTER)], found.outliers).drawing
        for title, unit, part in (("Residual force", "N", slice(0, 3)),
                                  ("Residual torque", "Nm", slice(3, 6)))
    ]  # fmt: skip
    force, torque = found.noise
    rows = [["force", f"{fixed(force, 3)} N"], ["torque", f"{fixed(torque, 4)} Nm"]]
    caption = "Length of the residual; red: down-weighted as outlier."
    return [blocks.Pictures(tuple(drawings), caption),
            blocks.Table(("noise of one axis, 1 sigma", "found"), rows, (2, 1), (1,))]  # fmt: skip


def tool_result(material: ShortMaterial[ToolCalibration]) -> list[blocks.Block]:
    """Return where the tip is."""
    found, nominal = material.found, material.nominal
    wide = max((e.interval[1] - e.interval[0]) / 2 for e in found.estimates)
    tiles = (
        blocks.Tile("tool centre x, y, z, mm", _point(found.tcp, decimals=2),
             f"± {mm(wide)} (95 %, the widest)"),
        blocks.Tile("tips apart before", mm(_rms(found.nominal_residual)), "rms, cell's tool"),
        blocks.Tile("tips apart after", mm(_rms(found.residual)), "rms, tool found"),
        blocks.Tile("noise of one touch", mm(found.noise), "1 sigma of one coordinate"),
    )  # fmt: skip
    before = "" if nominal is None else (
        f"The cell had the tool at {_point(nominal.chain().tool_position, decimals=2)} mm, in the "
        "axes of the flange."
    )  # fmt: skip
    return _result(found, tiles, before)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))


def tool_parameters(material: ShortMaterial[ToolCalibration]) -> list[blocks.Block]:
    """Return the tool centre with its intervals, and the touches."""
    found = material.found
    place = f"The fixed place is at {_point(found.point, decimals=2)} mm in the axes of the base."
    caption = (
        "How far each touch is from the fixed place: with the tool that the cell had, and with "
        "the one that was found. Red: down-weighted as outlier."
    )
    return [
        estimates_table(list(found.estimates), planned=False), blocks.Paragraph(place),
        blocks.Pictures((_touches(found),), caption),
    ]  # fmt: skip


def _touches(found: ToolCalibration) -> Drawing:
    before, after = (np.abs(r) * 1e3 for r in (found.nominal_residual, found.residual))
    chart = _bars("Every touch", "touch", "mm", [(before, BEFORE), (after, AFTER)], found.outliers)
    chart.legend((("before", BEFORE), ("after", AFTER)))
    return chart.drawing


PAYLOAD: tuple[blocks.Section[ShortMaterial[PayloadCalibration]], ...] = (
    blocks.Section("result", "Result", payload_result),
    blocks.Section("session", "Session and instrument", short_facts),
    blocks.Section("parameters", "What was found", payload_parameters,
            "Flange axes; intervals of 95 %."),
    blocks.Section("residual", "The residual", payload_residual,
            "Reading minus load and sensor zero, orientation by orientation."),
)  # fmt: skip
TOOL: tuple[blocks.Section[ShortMaterial[ToolCalibration]], ...] = (
    blocks.Section("result", "Result", tool_result),
    blocks.Section("session", "Session and instrument", short_facts),
    blocks.Section(
        "parameters", "What was found", tool_parameters, "Flange axes; intervals of 95 %."
    ),
)
