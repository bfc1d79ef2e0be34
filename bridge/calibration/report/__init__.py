"""Reports of calibration sessions for customers, as HTML and PDF."""

from gapbridge.bridge.calibration.report.data import CalibrationData, InstrumentFacts, SessionFacts
from gapbridge.bridge.calibration.report.report import write_report
from gapbridge.bridge.calibration.report.sections.result_section import required_accuracy
from gapbridge.bridge.calibration.report.sections.short_sections import ShortSessionData
from gapbridge.bridge.calibration.report.sections.verification_sections import VerificationData

__all__ = [
    "CalibrationData",
    "InstrumentFacts",
    "SessionFacts",
    "ShortSessionData",
    "VerificationData",
    "required_accuracy",
    "write_report",
]
