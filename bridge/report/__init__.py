"""The report of a diagnosis: one self-contained HTML file, one section a module."""

from bridge.report.page import write_report
from bridge.report.section import SECTIONS

__all__ = ["SECTIONS", "write_report"]
