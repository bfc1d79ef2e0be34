"""Reports of calibration sessions, for customers: one HTML file and a PDF."""

from gapbridge.bridge.calibration.report.facts import InstrumentFacts, SessionFacts
from gapbridge.bridge.calibration.report.report import (
    write_payload,
    write_report,
    write_tool,
    write_verification,
)

__all__ = [
    "InstrumentFacts",
    "SessionFacts",
    "write_payload",
    "write_report",
    "write_tool",
    "write_verification",
]
