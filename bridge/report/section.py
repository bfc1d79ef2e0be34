"""The sections of the report, in the order in which they stand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gapbridge.bridge.report import answer, data_quality, how_far, parameters, where, which
from gapbridge.bridge.report.material import Material


@dataclass(frozen=True)
class Section:
    """One section: what it is called, what it is for, and who writes it."""

    title: str
    about: str
    write: Callable[[Material], str]


SECTIONS: dict[str, Section] = {
    "answer": Section("The answer", "", answer.section),
    "where": Section(
        "Where the gap lies", "Which joints and axes it comes from, and what it follows.",
        where.section,
    ),
    "which": Section(
        "Which effect causes it", "Every effect that was tried, with the evidence for and against.",
        which.section,
    ),
    "how_far": Section(
        "How far it shrinks",
        "Judged only on measurements that the fit did not see.",
        how_far.section,
    ),
    "parameters": Section(
        "Parameters and next measurements",
        "What goes into the model, how surely, and what would settle the open questions.",
        parameters.section,
    ),
    "data_quality": Section(
        "Data quality", "What was used, what was excluded, what could not be seen.",
        data_quality.section,
    ),
}  # fmt: skip
