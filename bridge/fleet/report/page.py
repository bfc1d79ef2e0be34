"""The report of a fleet, one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gapbridge.bridge.document.blocks import Document, Part
from gapbridge.bridge.document.html import html
from gapbridge.bridge.document.provenance import origin_blocks, origin_line, provenance
from gapbridge.bridge.fleet.diagnosis_summary import FleetDiagnosis
from gapbridge.bridge.fleet.fit_summary import FleetFit
from gapbridge.bridge.fleet.report import diagnosis_sections, fit_sections, shared_sections
from gapbridge.bridge.fleet.runner import FleetRun
from gapbridge.bridge.fleet.session import Fleet
from gapbridge.bridge.report.labels import counted

DRIFTING = "Significant changes over the sessions of an arm."


def diagnosis_report(summary: FleetDiagnosis, done: FleetRun, fleet: Fleet) -> str:
    """Return the report of ``fleet diagnose`` as HTML."""
    drifts = [*shared_sections.drifts(summary.drifts), *diagnosis_sections.onsets(summary.onsets)]
    parts = (
        Part("answer", "The answer", "", diagnosis_sections.answer(summary, done)),
        Part("recurring", "Which effects recur", "Over all sessions whose log could show them.",
             diagnosis_sections.recurring(summary)),
        Part("drifting", "Which arms drift", DRIFTING, drifts),
        Part("outlying", "Outliers", "Sessions unlike the others of their kind.",
             shared_sections.outliers(summary.outliers)),
        Part("sessions", "Sessions", "What was used, and what was skipped.",
             shared_sections.sessions(done, diagnosis_sections.SESSION_HEADS,
                                      diagnosis_sections.session_cells)),
    )  # fmt: skip
    return _html("Diagnosis of a fleet", parts, done, fleet)


def fit_report(summary: FleetFit, done: FleetRun, fleet: Fleet) -> str:
    """Return the report of ``fleet fit`` as HTML."""
    parts = (
        Part("answer", "The answer", "", fit_sections.answer(summary)),
        Part("types", "What arms of a type have in common",
             "Flexibilities of the type, and their scatter between arms and between sessions.",
             fit_sections.types(summary)),
        Part("arms", "The arms", "Flexibilities of each arm, with the share from its own data.",
             fit_sections.arms(summary)),
        Part("drifting", "Which arms drift", DRIFTING, shared_sections.drifts(summary.drifts)),
        Part("outlying", "Outliers", "Arms and sessions unlike the others of their type.",
             shared_sections.outliers(summary.outliers)),
        Part("sessions", "Sessions", "What was used, and what was skipped.",
             shared_sections.sessions(done, fit_sections.SESSION_HEADS,
                                      fit_sections.session_cells(summary))),
    )  # fmt: skip
    return _html("Compliance of a fleet", parts, done, fleet)


def _html(title: str, parts: Sequence[Part], done: FleetRun, fleet: Fleet) -> str:
    cells = sorted({Path(o.cell) for o in done.outcomes if Path(o.cell).is_file()})
    # without the logs, which sessions.parquet lists
    origin = provenance({"cell": cells[: shared_sections.MAX_ROWS]})
    about = f"{counted(len(done.outcomes), 'session')} of {counted(fleet.arms, 'arm')}"
    document = Document(
        title, f"{about} · {origin_line(origin)}",
        (*parts, Part("origin", "Where this comes from", "", origin_blocks(origin)[1:])),
        f"{title} · {origin_line(origin)}",
    )  # fmt: skip
    return html(document)
