"""The report of a diagnosis: one self-contained HTML file, one section a module."""

from gapbridge.bridge.report.page import SECTIONS, write_report

__all__ = ["SECTIONS", "write_report"]
