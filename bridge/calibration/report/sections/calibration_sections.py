"""The sections of each report, in the order in which they stand."""

from __future__ import annotations

from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.calibration.report.sections.appendix import Appendix
from gapbridge.bridge.calibration.report.sections.budget_section import BudgetSection
from gapbridge.bridge.calibration.report.sections.errors_section import ErrorsSection
from gapbridge.bridge.calibration.report.sections.leftover_section import LeftoverSection
from gapbridge.bridge.calibration.report.sections.loads_section import LoadsSection
from gapbridge.bridge.calibration.report.sections.parameters_section import ParametersSection
from gapbridge.bridge.calibration.report.sections.poses_section import PosesSection
from gapbridge.bridge.calibration.report.sections.repeats_section import RepeatsSection
from gapbridge.bridge.calibration.report.sections.session_section import SessionSection
from gapbridge.bridge.calibration.report.sections.summary import Summary
from gapbridge.bridge.calibration.report.sections.workspace_section import WorkspaceSection
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
