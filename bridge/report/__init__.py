"""The report of a diagnosis: one self-contained HTML file, one section a module."""

from gapbridge.bridge.report.page import SECTIONS, report_text

__all__ = ["SECTIONS", "report_text"]
