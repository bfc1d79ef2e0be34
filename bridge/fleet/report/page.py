"""The report of a fleet: one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from gapbridge.bridge.document.blocks import Document, Part
from gapbridge.bridge.document.html import html
from gapbridge.bridge.document.output_file import write_text
from gapbridge.bridge.document.provenance import origin_blocks, origin_line, provenance
from gapbridge.bridge.fleet.diagnosis_summary import Diagnosed
from gapbridge.bridge.fleet.fit_summary import Fitted
from gapbridge.bridge.fleet.report import diagnosed_sections, fitted_sections, shared_sections
from gapbridge.bridge.fleet.runner import Done
from gapbridge.bridge.fleet.session import Found
from gapbridge.bridge.report.labels import counted

FILE = "report.html"


def write_diagnosed_report(together: Diagnosed, done: Done, found: Found, folder: Path) -> Path:
    """Write the report of ``fleet diagnose`` and return its path."""
    drifts = [*shared_sections.drifts(together.drifts), *diagnosed_sections.onsets(together.onsets)]
    parts = (
        Part("answer", "The answer", "", diagnosed_sections.answer(together, done)),
        Part("recurring", "Which effects recur", "Over all sessions whose log could show them.",
             diagnosed_sections.recurring(together)),
        Part("drifting", "Which arms drift", "What changes over an arm's sessions by more than it "
             "scatters.", drifts),
        Part("outlying", "What stands out", "Sessions unlike the others of their kind.",
             shared_sections.outliers(together.outliers)),
        Part("sessions", "Sessions", "What was used, and what was skipped.",
             shared_sections.sessions(done, diagnosed_sections.SESSION_HEADS,
                                      diagnosed_sections.session_cells)),
    )  # fmt: skip
    return _write(folder, "Diagnosis of a fleet", parts, done, found)


def write_fitted_report(together: Fitted, done: Done, found: Found, folder: Path) -> Path:
    """Write the report of ``fleet fit`` and return its path."""
    parts = (
        Part("answer", "The answer", "", fitted_sections.answer(together)),
        Part("types", "What arms of a type have in common",
             "Flexibilities of the type, how far arms scatter about them, how far sessions do.",
             fitted_sections.types(together)),
        Part("arms", "The arms", "Each arm's own flexibilities, with what they borrow.",
             fitted_sections.arms(together)),
        Part("drifting", "Which arms drift", "What changes over an arm's sessions by more than it "
             "scatters.", shared_sections.drifts(together.drifts)),
        Part("outlying", "What stands out", "Arms and sessions unlike the others of their type.",
             shared_sections.outliers(together.outliers)),
        Part("sessions", "Sessions", "What was used, and what was skipped.",
             shared_sections.sessions(done, fitted_sections.SESSION_HEADS,
                                      fitted_sections.session_cells(together))),
    )  # fmt: skip
    return _write(folder, "Compliance of a fleet", parts, done, found)


def _write(folder: Path, title: str, parts: Sequence[Part], done: Done, found: Found) -> Path:
    path = folder / FILE
    cells = sorted({Path(o.cell) for o in done.outcomes if Path(o.cell).is_file()})
    # of the logs, whose number has no end, sessions.parquet holds the names
    origin = provenance({"cell": cells[: shared_sections.MOST]})
    about = f"{counted(len(done.outcomes), 'session')} of {counted(found.arms, 'arm')}"
    document = Document(
        title, f"{about} · {origin_line(origin)}",
        (*parts, Part("origin", "Where this comes from", "", origin_blocks(origin)[1:])),
        f"{title} · {origin_line(origin)}",
    )  # fmt: skip
    write_text(path, html(document))
    return path
