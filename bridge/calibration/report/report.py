"""The reports of calibration sessions as files: HTML and PDF of one document."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from gapbridge.bridge.calibration.report.facts import SessionFacts
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.calibration.report.sections.calibration_sections import CALIBRATION
from gapbridge.bridge.calibration.report.sections.payload_sections import PAYLOAD, PayloadMaterial
from gapbridge.bridge.calibration.report.sections.signature_section import signature
from gapbridge.bridge.calibration.report.sections.tool_sections import TOOL, ToolMaterial
from gapbridge.bridge.calibration.report.sections.verification_sections import (
    VERIFICATION,
    VerificationMaterial,
)
from gapbridge.bridge.document.blocks import Document
from gapbridge.bridge.document.html import html
from gapbridge.bridge.document.output_file import replacing_bytes, write_text
from gapbridge.bridge.document.section import Section
from gapbridge.core.calibration.payload_session import PayloadCalibration
from gapbridge.core.calibration.plan import Plan
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.result import Calibration
from gapbridge.core.calibration.tool_session import ToolCalibration
from gapbridge.core.calibration.verify import Verification
from gapbridge.core.model import Model

M = TypeVar("M")


def write_report(
    calibration: Calibration, plan: Plan | None, session: SessionFacts, out: Path
) -> tuple[Path, Path]:
    """Write ``calibration.html`` and ``calibration.pdf`` into folder ``out``; return their paths.

    Raises RunError where a file cannot be written.
    """
    material = Material(calibration, plan, session)
    return _written(_document("Calibration", session, CALIBRATION, material), out, "calibration")


def write_verification(
    verification: Verification, session: SessionFacts, out: Path, readings: Readings | None = None
) -> tuple[Path, Path]:
    """Write ``verification.html`` and ``verification.pdf`` into folder ``out``; return their paths.

    ``readings`` are those that were verified: they tell the poses. Raises RunError where a file
    cannot be written.
    """
    material = VerificationMaterial(verification, session, readings)
    document = _document("Verification", session, VERIFICATION, material)
    return _written(document, out, "verification")


def write_payload(
    found: PayloadCalibration, session: SessionFacts, out: Path, nominal: Model | None = None
) -> tuple[Path, Path]:
    """Write ``payload.html`` and ``payload.pdf`` into folder ``out``; return their paths.

    ``nominal`` is the model as the cell had it. Raises RunError where a file cannot be written.
    """
    material = PayloadMaterial(found, session, nominal)
    return _written(_document("Load and force sensor", session, PAYLOAD, material), out, "payload")


def write_tool(
    found: ToolCalibration, session: SessionFacts, out: Path, nominal: Model | None = None
) -> tuple[Path, Path]:
    """Write ``tool.html`` and ``tool.pdf`` into folder ``out``; return their paths.

    ``nominal`` is the model as the cell had it. Raises RunError where a file cannot be written.
    """
    material = ToolMaterial(found, session, nominal)
    return _written(_document("Tool", session, TOOL, material), out, "tool")


def _document(
    what: str, session: SessionFacts, sections: Sequence[Section[M]], material: M
) -> Document:
    parts = [section.part(material) for section in sections]
    title = f"{what} of {session.cell}"
    software = f"Gapbridge {session.version}".strip()
    number = f"Report {session.number} · " if session.number else ""
    return Document(
        title,
        f"{number}Arm {session.arm}, {session.started:%d %B %Y} · {software}",
        (*(part for part in parts if part is not None), signature(session)),
        f"{number}{title[:1].lower()}{title[1:]} · {session.started:%Y-%m-%d} · {software}",
    )


def _written(document: Document, out: Path, name: str) -> tuple[Path, Path]:
    from gapbridge.bridge.document.pdf import pdf

    page, paper = out / f"{name}.html", out / f"{name}.pdf"
    write_text(page, html(document))
    with replacing_bytes(paper) as file:
        file.write(pdf(document))
    return page, paper
