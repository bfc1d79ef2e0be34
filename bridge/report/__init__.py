"""The report of a diagnosis: one self-contained HTML file, one section a module."""

from gapbridge.bridge.report.page import write_report
from gapbridge.bridge.report.sections import SECTIONS

__all__ = ["SECTIONS", "write_report"]
