"""report.html of a demo run: one file that opens offline."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gapbridge.bridge.demo.picture import arm_drawing, bars_drawing, coloured_rounds
from gapbridge.bridge.demo.result import Result
from gapbridge.bridge.demo.terminal import truth_rows
from gapbridge.bridge.document.axes import Chart, logarithmic, named, scale
from gapbridge.bridge.document.blocks import (
    Block,
    Bullets,
    Cell,
    Columns,
    Document,
    Heading,
    Named,
    Pairs,
    Paragraph,
    Part,
    Pictures,
    Table,
)
from gapbridge.bridge.document.drawing import AFTER, BEFORE, EDGE, INK, Drawing
from gapbridge.bridge.document.html import html
from gapbridge.bridge.document.notes import note_texts
from gapbridge.bridge.document.provenance import origin_blocks, origin_line
from gapbridge.core.notes import Reason

FIT_SCOPE = (
    "Only the flexibilities of this fit are kept, even where it estimated a tool point: other "
    "effects are identified by the diagnosis."
)
CELL_NOTES = (Reason.TOOL_WRITTEN, Reason.TOOL_OFF_WRITTEN)  # what `gapbridge fit` would write
NARROW = 380.0  # px of a chart that fits on a phone
NEXT_STEPS = (
    "Write a cell for your own robot: gapbridge init HOST --out CELL.",
    "Check it: gapbridge check CELL --live, then watch it: gapbridge run CELL --observe.",
    "Calibrate it with an instrument: gapbridge calibrate CELL.",
)


def page(result: Result, diagnosis: str, origin: Mapping[str, Any] | None = None) -> str:
    """Return the HTML; ``diagnosis`` is the printed text, ``origin`` the run's provenance."""
    return html(document(result, diagnosis, origin or {}))


def document(result: Result, diagnosis: str, origin: Mapping[str, Any]) -> Document:
    """Return the report as blocks."""
    truth = _truth(result)
    parts: list[tuple[str, str, list[Block]]] = [
        ("result", "The result", _result(result)),
        *([("truth", "Hidden effects and their estimates", truth)] if truth else []),
        ("visits", "Every visit", [Pictures((_errors(result),))]),
        ("flexibilities", "Identified flexibilities", _flexibilities(result)),
        ("diagnosis", "Diagnosis of the remaining error", _diagnosis(diagnosis)),
        ("figures", "Run and link", [_figures(result), *origin_blocks(origin)]),
    ]
    software = origin_line(origin)
    return Document(
        f"Demo on a simulated {result.model.arm.name}",
        f"Link {result.link}, seed {result.seed} · {software}",
        tuple(Part(key, title, "", blocks) for key, title, blocks in parts if blocks),
        f"Demo of {software}, seed {result.seed}",
    )


def _result(result: Result) -> list[Block]:
    errors = result.summary()["tcp_error_mm"]
    ratio = errors["without"]["rms"] / errors["with"]["rms"]
    lead = (
        f"Without compensation the TCP error is {errors['without']['rms']:.3f} mm "
        f"rms (at most {errors['without']['max']:.3f}); with it, {errors['with']['rms']:.3f} mm "
        f"({errors['with']['max']:.3f}): {ratio:.0f} times smaller. The arm's repeatability is "
        f"{result.repeatability * 1e3:.3f} mm. Its true flexibilities are drawn from seed "
        f"{result.seed} and are not known to the program that corrects it."
    )
    return [
        Paragraph(lead, "lead"), Heading("What to do now"), Bullets(NEXT_STEPS),
        Pictures((arm_drawing(result), bars_drawing(result))),
    ]  # fmt: skip


def _truth(result: Result) -> list[Block]:
    """Return the hidden parameters with their estimates; empty where nothing was hidden."""
    if result.hidden is None:
        return []
    fitted = result.summary()["tcp_error_mm"]["fitted"]["rms"]
    rows: list[list[Cell]] = [
        [Named("", code=name), true, estimate or "not found"]
        for name, true, estimate in truth_rows(result)
    ]
    return [
        Paragraph(f"Fitted flexibilities alone left {fitted:.3f} mm: {result.hidden.description}."),
        Table(("parameter", "true", "estimated"), rows),
    ]  # fmt: skip


def _errors(result: Result) -> Drawing:
    rounds = coloured_rounds(result)
    visit = [float(i) for i in range(1, len(result.loads) + 1)]
    every = [v * 1e3 for _, error, _ in rounds for v in error]
    errors = logarithmic("mm", [*every, result.repeatability * 1e3])
    chart = Chart("TCP error", scale("visit", visit, zero=False), errors, width=NARROW)
    for _, error, colour in rounds:
        hints = [
            f"{load}: {e * 1e3:.3f} mm, q = {np.round(q, 3).tolist()}"
            for load, e, q in zip(result.loads, error, result.uncompensated.nominal_q, strict=True)
        ]
        chart.points(visit, [*error * 1e3], colour, radius=3.4, hints=hints)
    chart.level(result.repeatability * 1e3, "repeatability", EDGE)
    chart.legend([(name, colour) for name, _, colour in rounds])
    return chart.drawing


def _flexibilities(result: Result) -> list[Block]:
    fit = result.identification
    n = len(fit.axial)
    kinds = (
        ("axial", fit.axial, fit.std_axial, fit.identifiable[:n], BEFORE, -0.2),
        ("radial", fit.radial, fit.std_radial, fit.identifiable[n:], AFTER, 0.2),
    )
    tops = [v * 1e6 for _, value, std, shown, _, _ in kinds for v in (value + 2 * std)[shown]]
    labels = [f"joint {i + 1}" for i in range(n)]
    chart = Chart(
        "Flexibility, lines: 2 sigma", named("", labels), scale("µrad/Nm", tops), width=NARROW
    )
    cells: list[list[str]] = [[str(i + 1)] for i in range(n)]
    for _, value, std, shown, colour, shift in kinds:
        for i in range(n):
            if not shown[i]:
                cells[i].append("not identifiable")
                continue
            v, s = float(value[i]) * 1e6, float(std[i]) * 1e6
            cells[i].append(f"{v:.3f} ± {s:.3f}")
            chart.column(i + shift, v, colour, 0.36)
            chart.line([i + shift] * 2, [max(v - 2 * s, 0.0), v + 2 * s], INK)
    chart.legend([(name, colour) for name, _, _, _, colour, _ in kinds])
    shown_notes = (n for n in (*fit.notes, *fit.combinations) if n.reason not in CELL_NOTES)
    notes = note_texts(tuple(shown_notes))
    heads = ("joint", "axial, µrad/Nm", "radial, µrad/Nm")
    return [
        Pictures((chart.drawing,)), Table(heads, cells, (0.5, 1, 1)), Paragraph(FIT_SCOPE),
        *([Bullets(notes)] if notes else []),
    ]  # fmt: skip


def _diagnosis(text: str) -> list[Block]:
    lines = [line.strip() for line in text.splitlines()]
    return [
        *(Paragraph(line) for line in lines if line),
        Paragraph("With charts: diagnosis/report.html.", "note"),
    ]


def _resolution(length: float) -> str:
    return f"{length * 1e3:.3g} mm" if length else "64-bit floats"


def _figures(result: Result) -> Columns:
    figures, loop = result.summary(), result.loop
    pairs = (
        ("link", result.link),
        ("measured poses in the fit", f"{figures['samples']}"),
        ("setpoints written", f"{figures['setpoints_written']}"),
        ("rate of the loop", f"{loop.rate:.1f} Hz"),
        ("cycles missed", f"{loop.missed} of {loop.cycles}"),
        ("age of the state behind a setpoint, p99", f"{loop.p99:.0f} µs"),
        ("resolution of the written values, at the TCP", _resolution(result.resolution.written)),
        ("resolution of the joint readings, at the TCP", _resolution(result.resolution.read)),
        ("meaning", result.resolution.note or "the link loses no resolution"),
        ("whole demo", f"{result.duration:.0f} s"),
    )
    return Columns((Pairs(pairs),))
