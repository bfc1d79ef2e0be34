"""The short reports: payload and force sensor, and tool."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from gapbridge.bridge.calibration.report.data import SessionFacts
from gapbridge.bridge.calibration.report.sections.parameters_section import estimates_table
from gapbridge.bridge.calibration.report.sections.session_section import facts_blocks
from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.axes import Chart, named, scale
from gapbridge.bridge.document.drawing import AFTER, BAD_DOT, BEFORE, Drawing
from gapbridge.bridge.document.notes import note_texts, short_text
from gapbridge.bridge.document.numbers import fixed, mm
from gapbridge.bridge.report.labels import parameter_title, sentence
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.payload_session import PayloadCalibration
from gapbridge.core.calibration.tool_session import ToolCalibration
from gapbridge.core.model import Model

F = TypeVar("F", bound=PayloadCalibration | ToolCalibration)


@dataclass(frozen=True)
class ShortSessionData(Generic[F]):
    """The result of a short session; ``nominal``: the cell's previous model."""

    result: F
    session: SessionFacts
    nominal: Model | None = None


def _result(
    result: PayloadCalibration | ToolCalibration, tiles: tuple[blocks.Tile, ...], before: str
) -> list[blocks.Block]:
    """Return the verdict, the next steps, the main figures, and the previous values."""
    badge = (
        blocks.Badge("Found, see remarks", blocks.DOUBTFUL)
        if result.notes
        else blocks.Badge("Found", blocks.GOOD)
    )
    return [
        blocks.Verdict(badge, sentence(short_text(result))),
        blocks.Heading("What to do now"), blocks.Bullets(tuple(_next_steps(result))),
        blocks.Tiles(tiles),
        *([blocks.Paragraph(before)] if before else []),
    ]  # fmt: skip


def _next_steps(result: PayloadCalibration | ToolCalibration) -> list[str]:
    """Return what the user does next, most urgent first."""
    what = "payload and centre of gravity" if isinstance(result, PayloadCalibration) else "TCP"
    first = [
        "See the remarks under “Session and instrument”, and repeat the measurements they name."
    ]
    return [
        *(first if result.notes else []),
        f"Set the same {what} in the robot controller; gapbridge check CELL --live compares both.",
        "Run the new cell without writing first (gapbridge run CELL --observe), then let it write "
        "(gapbridge run CELL --arm).",
        "Measure again after every collision and every change of the tool.",
    ]


def _point(values: Sequence[float] | Array, factor: float = 1e3, decimals: int = 1) -> str:
    return ", ".join(fixed(float(v) * factor, decimals) for v in np.asarray(values))


def _bars(
    title: str, names: str, unit: str, series: Sequence[tuple[Array, str]],
    outliers: Collection[int],
) -> Chart:  # fmt: skip
    """Return a column chart of ``series``: (magnitudes in ``unit``, colour), one group per entry.

    Outliers of the last series are red.
    """
    count = len(series[0][0])
    magnitudes = [float(v) for values, _ in series for v in values]
    labels = [str(i + 1) for i in range(count)]
    chart = Chart(
        title, named(names, labels), scale(unit, magnitudes), width=340 + 80 * (len(series) - 1)
    )
    width = 0.72 / len(series)
    for k, (values, colour) in enumerate(series):
        shift = (k - (len(series) - 1) / 2) * (width + 0.04)
        for i, value in enumerate(values):
            marked = k == len(series) - 1 and i in outliers
            chart.column(i + shift, float(value), BAD_DOT if marked else colour, width)
    return chart


def payload_result(data: ShortSessionData[PayloadCalibration]) -> list[blocks.Block]:
    """Return mass, centre of gravity and the sensor's bias."""
    result, nominal = data.result, data.nominal
    mass, *cog = (e for e in result.estimates[:4])
    widest = max((e.interval[1] - e.interval[0]) / 2 for e in cog)
    tiles = (
        blocks.Tile("mass", f"{fixed(mass.value, 3)} kg",
             f"± {fixed((mass.interval[1] - mass.interval[0]) / 2, 3)} kg (95 %)"),
        blocks.Tile("centre of gravity x, y, z, mm", _point(result.cog),
             f"± {fixed(widest * 1e3, 1)} mm (95 %, the widest)"),
        blocks.Tile("sensor zero of force, N", _point(result.bias[:3], 1.0, 2), "along x, y, z"),
        blocks.Tile("sensor zero of torque, Nm", _point(result.bias[3:], 1.0, 3), "about x, y, z"),
    )  # fmt: skip
    before = "" if nominal is None else (
        f"The cell had {fixed(nominal.payload_mass, 3)} kg at "
        f"{_point(nominal.payload_cog)} mm from the flange."
    )  # fmt: skip
    return _result(result, tiles, before)


def short_facts(data: ShortSessionData[F]) -> list[blocks.Block]:
    """Return the facts of a short session."""
    result = data.result
    what = "orientations" if isinstance(result, PayloadCalibration) else "touches"
    counts = [(what, str(len(result.residual)))]
    return facts_blocks(data.session, counts, 1, note_texts(result.notes, parameter_title))


def payload_parameters(data: ShortSessionData[PayloadCalibration]) -> list[blocks.Block]:
    """Return the ten parameters: mass, centre of gravity and bias."""
    return [estimates_table([e for e in data.result.estimates if e.shown], planned=False)]


def payload_residual(data: ShortSessionData[PayloadCalibration]) -> list[blocks.Block]:
    """Return the residuals of force and torque, and the estimated noise."""
    result = data.result
    drawings = [
        _bars(title, "orientation", unit,
              [(np.linalg.norm(result.residual[:, part], axis=1), AFTER)], result.outliers).drawing
        for title, unit, part in (("Residual force", "N", slice(0, 3)),
                                  ("Residual torque", "Nm", slice(3, 6)))
    ]  # fmt: skip
    force, torque = result.noise
    rows = [["force", f"{fixed(force, 3)} N"], ["torque", f"{fixed(torque, 4)} Nm"]]
    caption = "Length of the residual; red: down-weighted as outlier."
    return [blocks.Pictures(tuple(drawings), caption),
            blocks.Table(("noise of one axis, 1 sigma", "found"), rows, (2, 1), (1,))]  # fmt: skip


def tool_result(data: ShortSessionData[ToolCalibration]) -> list[blocks.Block]:
    """Return the TCP and the scatter of the contacts before and after."""
    result, nominal = data.result, data.nominal
    widest = max((e.interval[1] - e.interval[0]) / 2 for e in result.estimates)
    tiles = (
        blocks.Tile("tool centre x, y, z, mm", _point(result.tcp, decimals=2),
             f"± {mm(widest)} (95 %, the widest)"),
        blocks.Tile("scatter before", mm(_rms(result.nominal_residual)), "rms, cell's tool"),
        blocks.Tile("scatter after", mm(_rms(result.residual)), "rms, identified tool"),
        blocks.Tile("noise of one touch", mm(result.noise), "1 sigma of one coordinate"),
    )  # fmt: skip
    before = "" if nominal is None else (
        f"The cell had the tool at {_point(nominal.chain().tool_position, decimals=2)} mm, in the "
        "axes of the flange."
    )  # fmt: skip
    return _result(result, tiles, before)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))


def tool_parameters(data: ShortSessionData[ToolCalibration]) -> list[blocks.Block]:
    """Return the TCP with its intervals, and the residual of each contact."""
    result = data.result
    place = f"The fixed point is at {_point(result.point, decimals=2)} mm in the axes of the base."
    caption = (
        "Distance of each contact from the fixed point: with the cell's previous tool and with the "
        "identified one. Red: down-weighted as outlier."
    )
    return [
        estimates_table(list(result.estimates), planned=False), blocks.Paragraph(place),
        blocks.Pictures((_contact_chart(result),), caption),
    ]  # fmt: skip


def _contact_chart(result: ToolCalibration) -> Drawing:
    before, after = (np.abs(r) * 1e3 for r in (result.nominal_residual, result.residual))
    chart = _bars("Every touch", "touch", "mm", [(before, BEFORE), (after, AFTER)], result.outliers)
    chart.legend((("before", BEFORE), ("after", AFTER)))
    return chart.drawing


PAYLOAD: tuple[blocks.Section[ShortSessionData[PayloadCalibration]], ...] = (
    blocks.Section("result", "Result", payload_result),
    blocks.Section("session", "Session and instrument", short_facts),
    blocks.Section("parameters", "Identified parameters", payload_parameters,
            "Flange axes; intervals of 95 %."),
    blocks.Section("residual", "The residual", payload_residual,
            "Reading minus load and sensor zero, orientation by orientation."),
)  # fmt: skip
TOOL: tuple[blocks.Section[ShortSessionData[ToolCalibration]], ...] = (
    blocks.Section("result", "Result", tool_result),
    blocks.Section("session", "Session and instrument", short_facts),
    blocks.Section(
        "parameters", "Identified parameters", tool_parameters, "Flange axes; intervals of 95 %."
    ),
)
