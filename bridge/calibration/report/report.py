"""The reports of calibration sessions as files: HTML and PDF of one document."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gapbridge.bridge.calibration.report.facts import SessionFacts
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.calibration.report.sections.errors_section import (
    before_and_after,
    over_the_workspace,
)
from gapbridge.bridge.calibration.report.sections.loads_section import over_the_load, pose_accuracy
from gapbridge.bridge.calibration.report.sections.parameters_section import parameters, residual
from gapbridge.bridge.calibration.report.sections.poses_section import all_readings, poses
from gapbridge.bridge.calibration.report.sections.result_section import summary, uncertainty_budget
from gapbridge.bridge.calibration.report.sections.session_section import session_and_instrument
from gapbridge.bridge.calibration.report.sections.short_sections import (
    PAYLOAD,
    TOOL,
    ShortMaterial,
)
from gapbridge.bridge.calibration.report.sections.verification_sections import (
    VERIFICATION,
    VerificationMaterial,
)
from gapbridge.bridge.document.blocks import Document, Part, Section, Table, parts
from gapbridge.bridge.document.html import html
from gapbridge.bridge.document.output_file import replacing_bytes, write_text
from gapbridge.core.calibration.payload_session import PayloadCalibration

AnyMaterial = Material | VerificationMaterial | ShortMaterial[Any]
LINE = "_" * 24
CALIBRATION: tuple[Section[Material], ...] = (
    Section("result", "Result", summary),
    Section("session", "Session and instrument", session_and_instrument),
    Section("errors", "Before and after", before_and_after),
    Section("workspace", "Over the workspace", over_the_workspace),
    Section("loads", "Over the load", over_the_load,
            "Errors by what hung on the flange; outliers are left out."),
    Section("repeats", "Pose accuracy and repeatability", pose_accuracy,
            "In the terms of ISO 9283: AP and RP of every pose that was visited more than once."),
    Section("uncertainty", "Uncertainty budget", uncertainty_budget,
            "In the manner of the GUM: how surely the tool is where the calibrated model puts it, "
            "along one axis of the base."),
    Section("parameters", "Parameters of the model", parameters,
            "What this arm has beyond the model that the cell had; intervals of 95 %."),
    Section("residual", "The residual", residual,
            "What the calibrated model still misses is examined: does any further effect show?"),
    Section("poses", "Poses", poses,
            "Chosen so that they determine the parameters best; those kept out of the fit judge "
            "it."),
    Section("readings", "All readings", all_readings,
            "In the order in which they were taken; errors in mm.", folded=True),
)  # fmt: skip


def write_report(material: AnyMaterial, out: Path) -> tuple[Path, Path]:
    """Write the report as HTML and as PDF into folder ``out``; return their paths.

    They are called calibration, verification, payload or tool. Raises RunError where a file cannot
    be written.
    """
    from gapbridge.bridge.document.pdf import pdf

    if isinstance(material, Material):
        name, what, made = "calibration", "Calibration", parts(CALIBRATION, material)
    elif isinstance(material, VerificationMaterial):
        name, what, made = "verification", "Verification", parts(VERIFICATION, material)
    elif isinstance(material.found, PayloadCalibration):
        name, what, made = "payload", "Load and force sensor", parts(PAYLOAD, material)
    else:
        name, what, made = "tool", "Tool", parts(TOOL, material)
    document = _document(what, material.session, made)
    page, paper = out / f"{name}.html", out / f"{name}.pdf"
    write_text(page, html(document))
    with replacing_bytes(paper) as file:
        file.write(pdf(document))
    return page, paper


def _document(what: str, session: SessionFacts, made: tuple[Part, ...]) -> Document:
    title = f"{what} of {session.cell}"
    software = f"Gapbridge {session.version}".strip()
    number = f"Report {session.number} · " if session.number else ""
    return Document(
        title,
        f"{number}Arm {session.arm}, {session.started:%d %B %Y} · {software}",
        (*made, signature(session)),
        f"{number}{title[:1].lower()}{title[1:]} · {session.started:%Y-%m-%d} · {software}",
    )


def signature(session: SessionFacts) -> Part:
    """Return the last section: who measured, who releases, room for name, date and signature."""
    rows = [
        ["measured by", session.operator or LINE, LINE, LINE],
        ["released by", LINE, LINE, LINE],
    ]
    table = Table(("", "name", "date", "signature"), rows, (1.0, 1.8, 1.8, 1.8))
    number = f" of report {session.number}" if session.number else ""
    about = f"The figures{number} hold for the cell file whose SHA-256 stands under Session."
    return Part("signature", "Signatures", about if session.cell_sha256 else "", (table,))
