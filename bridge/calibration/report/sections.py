"""The sections of each report, in the order in which they stand."""

from __future__ import annotations

from bridge.calibration.report.appendix import Appendix
from bridge.calibration.report.budget_section import BudgetSection
from bridge.calibration.report.errors_section import ErrorsSection
from bridge.calibration.report.leftover_section import LeftoverSection
from bridge.calibration.report.loads_section import LoadsSection
from bridge.calibration.report.material import Material
from bridge.calibration.report.parameters_section import ParametersSection
from bridge.calibration.report.poses_section import PosesSection
from bridge.calibration.report.repeats_section import RepeatsSection
from bridge.calibration.report.session_section import SessionSection
from bridge.calibration.report.summary import Summary
from bridge.calibration.report.workspace_section import WorkspaceSection
from bridge.document.section import Section

CALIBRATION: tuple[Section[Material], ...] = (
    Summary(),
    SessionSection(),
    ErrorsSection(),
    WorkspaceSection(),
    LoadsSection(),
    RepeatsSection(),
    BudgetSection(),
    ParametersSection(),
    LeftoverSection(),
    PosesSection(),
    Appendix(),
)
