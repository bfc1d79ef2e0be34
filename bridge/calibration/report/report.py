"""The reports of calibration sessions as files: HTML and PDF of one document."""

from __future__ import annotations

from pathlib import Path

from bridge.calibration.report.blocks import Document
from bridge.calibration.report.facts import SessionFacts
from bridge.calibration.report.html import html
from bridge.calibration.report.material import Material
from bridge.calibration.report.sections import CALIBRATION
from bridge.output_file import replacing_bytes, write_text
from core.calibration.plan import Plan
from core.calibration.result import Calibration


def write_report(
    calibration: Calibration, plan: Plan | None, session: SessionFacts, out: Path
) -> tuple[Path, Path]:
    """Write ``calibration.html`` and ``calibration.pdf`` into folder ``out``; return their paths.

    Raises RunError where a file cannot be written.
    """
    material = Material(calibration, plan, session)
    parts = [section.part(material) for section in CALIBRATION]
    document = Document(
        f"Calibration of {session.cell}",
        f"Arm {session.arm}, {session.started:%d %B %Y} · Gapbridge",
        tuple(part for part in parts if part is not None),
        f"Gapbridge · calibration of {session.cell} · {session.started:%Y-%m-%d}",
    )
    return _written(document, out, "calibration")


def _written(document: Document, out: Path, name: str) -> tuple[Path, Path]:
    from bridge.calibration.report.pdf import pdf

    page, paper = out / f"{name}.html", out / f"{name}.pdf"
    write_text(page, html(document))
    with replacing_bytes(paper) as file:
        file.write(pdf(document))
    return page, paper
