"""The sections of the report, in the order in which they stand."""

from __future__ import annotations

from gapbridge.bridge.document.section import Section
from gapbridge.bridge.report.answer import Answer
from gapbridge.bridge.report.data_quality import DataQuality
from gapbridge.bridge.report.how_far import HowFar
from gapbridge.bridge.report.material import Material
from gapbridge.bridge.report.parameters import Parameters
from gapbridge.bridge.report.where import Where
from gapbridge.bridge.report.which import Which

SECTIONS: tuple[Section[Material], ...] = (
    Answer(), Where(), Which(), HowFar(), Parameters(), DataQuality(),
)  # fmt: skip
