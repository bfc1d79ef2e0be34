"""The sections of each report, in the order in which they stand."""

from __future__ import annotations

from bridge.calibration.report.budget_section import BudgetSection
from bridge.calibration.report.errors_section import ErrorsSection
from bridge.calibration.report.material import Material
from bridge.calibration.report.parameters_section import ParametersSection
from bridge.calibration.report.section import Section
from bridge.calibration.report.session_section import SessionSection
from bridge.calibration.report.summary import Summary

CALIBRATION: tuple[Section[Material], ...] = (
    Summary(),
    SessionSection(),
    ErrorsSection(),
    BudgetSection(),
    ParametersSection(),
)
