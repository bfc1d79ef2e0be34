"""The sections of the report, in the order in which they stand."""

from __future__ import annotations

from gapbridge.bridge.document.section import Section
from gapbridge.bridge.report.answer import answer
from gapbridge.bridge.report.data_quality import data_quality
from gapbridge.bridge.report.how_far import how_far
from gapbridge.bridge.report.material import Material
from gapbridge.bridge.report.parameters import parameters
from gapbridge.bridge.report.where import where
from gapbridge.bridge.report.which import which

SECTIONS: tuple[Section[Material], ...] = (
    Section("answer", "The answer", answer),
    Section("where", "Where the gap lies", where,
            "Which joints and axes it comes from, and what it follows."),
    Section("which", "Which effect causes it", which,
            "Every effect that was tried, with the evidence for and against."),
    Section("how_far", "How far it shrinks", how_far,
            "Judged only on measurements that the fit did not see."),
    Section("parameters", "Parameters and next measurements", parameters,
            "What goes into the model, how surely, and what would settle the open questions."),
    Section("data_quality", "Data quality", data_quality,
            "What was used, what was excluded, what could not be seen."),
)  # fmt: skip
