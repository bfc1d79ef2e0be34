"""Reports of calibration sessions, for customers: one HTML file and a PDF."""

from gapbridge.bridge.calibration.report.facts import InstrumentFacts, SessionFacts
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.calibration.report.report import write_report
from gapbridge.bridge.calibration.report.sections.short_sections import ShortMaterial
from gapbridge.bridge.calibration.report.sections.verification_sections import VerificationMaterial

__all__ = [
    "InstrumentFacts",
    "Material",
    "SessionFacts",
    "ShortMaterial",
    "VerificationMaterial",
    "write_report",
]
