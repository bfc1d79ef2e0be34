"""Writes the reports of calibration sessions, each as HTML and PDF of one document."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gapbridge.bridge.calibration.report.data import CalibrationData, SessionFacts
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
    ShortSessionData,
)
from gapbridge.bridge.calibration.report.sections.verification_sections import (
    VERIFICATION,
    VerificationData,
)
from gapbridge.bridge.document.blocks import Document, Part, Section, Table, parts
from gapbridge.bridge.document.html import html
from gapbridge.bridge.document.output_file import write_together
from gapbridge.core.calibration.payload_session import PayloadCalibration

AnyData = CalibrationData | VerificationData | ShortSessionData[Any]
SIGNATURE_LINE = "_" * 24
CALIBRATION: tuple[Section[CalibrationData], ...] = (
    Section("result", "Result", summary),
    Section("session", "Session and instrument", session_and_instrument),
    Section("errors", "Before and after", before_and_after),
    Section("workspace", "Over the workspace", over_the_workspace),
    Section("loads", "Over the load", over_the_load,
            "Errors by load on the flange; without outliers."),
    Section("repeats", "Pose accuracy and repeatability", pose_accuracy,
            "In the terms of ISO 9283: AP and RP of every pose that was visited more than once."),
    Section("uncertainty", "Uncertainty budget", uncertainty_budget,
            "After the GUM: uncertainty of the tool's predicted position along one base axis."),
    Section("parameters", "Parameters of the model", parameters,
            "Corrections to the cell's previous model; 95 % intervals."),
    Section("residual", "The residual", residual,
            "Diagnosis of the error that the calibrated model leaves: is there a further effect?"),
    Section("poses", "Poses", poses,
            "Selected to determine the parameters best; held-out poses validate the fit."),
    Section("readings", "All readings", all_readings,
            "In the order in which they were taken; errors in mm.", folded=True),
)  # fmt: skip


def write_report(data: AnyData, out: Path) -> tuple[Path, Path]:
    """Write the report as HTML and PDF into folder ``out``; return both paths.

    File names: calibration, verification, payload or tool. Raises RunError if a file cannot be
    written.
    """
    from gapbridge.bridge.document.pdf import pdf

    if isinstance(data, CalibrationData):
        name, kind, sections = "calibration", "Calibration", parts(CALIBRATION, data)
    elif isinstance(data, VerificationData):
        name, kind, sections = "verification", "Verification", parts(VERIFICATION, data)
    elif isinstance(data.result, PayloadCalibration):
        name, kind, sections = "payload", "Load and force sensor", parts(PAYLOAD, data)
    else:
        name, kind, sections = "tool", "Tool", parts(TOOL, data)
    document = _document(kind, data.session, sections)
    page, paper = out / f"{name}.html", out / f"{name}.pdf"
    write_together({page: html(document), paper: pdf(document)})
    return page, paper


def _document(kind: str, session: SessionFacts, sections: tuple[Part, ...]) -> Document:
    title = f"{kind} of {session.cell}"
    software = f"Gapbridge {session.version}".strip()
    number = f"Report {session.number} · " if session.number else ""
    return Document(
        title,
        f"{number}Arm {session.arm}, {session.started:%d %B %Y} · {software}",
        (*sections, signature(session)),
        f"{number}{title[:1].lower()}{title[1:]} · {session.started:%Y-%m-%d} · {software}",
    )


def signature(session: SessionFacts) -> Part:
    """Return the last section: lines for names, dates and signatures."""
    rows = [
        ["measured by", session.operator or SIGNATURE_LINE, SIGNATURE_LINE, SIGNATURE_LINE],
        ["released by", SIGNATURE_LINE, SIGNATURE_LINE, SIGNATURE_LINE],
    ]
    table = Table(("", "name", "date", "signature"), rows, (1.0, 1.8, 1.8, 1.8))
    number = f" of report {session.number}" if session.number else ""
    about = f"The figures{number} are valid for the cell file with the SHA-256 given under Session."
    return Part("signature", "Signatures", about if session.cell_sha256 else "", (table,))
