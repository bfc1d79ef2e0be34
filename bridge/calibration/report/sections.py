"""The sections of each report, in the order in which they stand."""

from __future__ import annotations

from gapbridge.bridge.calibration.report.appendix import Appendix
from gapbridge.bridge.calibration.report.budget_section import BudgetSection
from gapbridge.bridge.calibration.report.errors_section import ErrorsSection
from gapbridge.bridge.calibration.report.leftover_section import LeftoverSection
from gapbridge.bridge.calibration.report.loads_section import LoadsSection
from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.calibration.report.parameters_section import ParametersSection
from gapbridge.bridge.calibration.report.poses_section import PosesSection
from gapbridge.bridge.calibration.report.repeats_section import RepeatsSection
from gapbridge.bridge.calibration.report.session_section import SessionSection
from gapbridge.bridge.calibration.report.summary import Summary
from gapbridge.bridge.calibration.report.workspace_section import WorkspaceSection
from gapbridge.bridge.document.section import Section

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
