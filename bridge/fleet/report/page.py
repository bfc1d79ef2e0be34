"""The page: one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path

from plotly.offline import get_plotlyjs

from gapbridge.bridge.document.output_file import write_text
from gapbridge.bridge.fleet.diagnosis_summary import Diagnosed
from gapbridge.bridge.fleet.fit_summary import Fitted
from gapbridge.bridge.fleet.outcome_words import counted
from gapbridge.bridge.fleet.report import diagnosed_sections, fitted_sections, shared_sections
from gapbridge.bridge.fleet.runner import Done
from gapbridge.bridge.fleet.session import Found

FILE = "report.html"


@dataclass(frozen=True)
class Part:
    """One section, written."""

    key: str
    title: str
    about: str
    body: str


def write_diagnosed_report(together: Diagnosed, done: Done, found: Found, folder: Path) -> Path:
    """Write the report of ``fleet diagnose`` and return its path."""
    drifts = shared_sections.drifts(together.drifts) + diagnosed_sections.onsets(together.onsets)
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
    write_text(path, _page(title, parts, done, found))
    return path


def _page(title: str, parts: Sequence[Part], done: Done, found: Found) -> str:
    links = "".join(f'<a href="#{p.key}">{escape(p.title)}</a>' for p in parts)
    body = "".join(
        f'<section id="{p.key}"><h2>{escape(p.title)}</h2>'
        f'<p class="about">{escape(p.about)}</p>{p.body}</section>'
        for p in parts
    )
    about = f"{counted(len(done.outcomes), 'session')} of {counted(found.arms, 'arm')}"
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<title>{escape(title)}</title><link rel="icon" href="data:,">'
        f"<style>{_own('style.css')}</style></head><body>"
        f"<header><h1>{escape(title)}</h1><p>{escape(about)} · Gapbridge</p>"
        f"<nav>{links}</nav></header><main>{body}</main>"
        f"<script>{get_plotlyjs()}</script><script>{_own('page.js')}</script></body></html>\n"
    )


def _own(name: str) -> str:
    return files("gapbridge.bridge.report").joinpath(name).read_text(encoding="utf-8")
