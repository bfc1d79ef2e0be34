"""The sections of a calibration's report, in the order in which they stand."""

from __future__ import annotations

from gapbridge.bridge.calibration.report.material import Material
from gapbridge.bridge.calibration.report.sections.errors_section import (
    before_and_after,
    over_the_workspace,
)
from gapbridge.bridge.calibration.report.sections.loads_section import over_the_load, pose_accuracy
from gapbridge.bridge.calibration.report.sections.parameters_section import parameters, residual
from gapbridge.bridge.calibration.report.sections.poses_section import all_readings, poses
from gapbridge.bridge.calibration.report.sections.result_section import summary, uncertainty_budget
from gapbridge.bridge.calibration.report.sections.session_section import session_and_instrument
from gapbridge.bridge.document.blocks import Section

CALIBRATION: tuple[Section[Material], ...] = (
    Section("result", "Result", summary),
    Section("session", "Session and instrument", session_and_instrument),
    Section("errors", "Before and after", before_and_after),
    Section("workspace", "Over the workspace", over_the_workspace),
    Section("loads", "Over the load", over_the_load,
            "Errors by what hung on the flange; outliers are left out."),
    Section("repeats", "Pose accuracy and repeatability", pose_accuracy,
            "In the terms of ISO 9283: AP and RP of every pose that was visited more than once."),
    Section("uncertainty", "Uncertainty budget", uncertainty_budget,
            "In the manner of the GUM: how surely the tool is where the calibrated model puts it, "
            "along one axis of the base."),
    Section("parameters", "Parameters of the model", parameters,
            "What this arm has beyond the model that the cell had; intervals of 95 %."),
    Section("residual", "The residual", residual,
            "What the calibrated model still misses is examined: does any further effect show?"),
    Section("poses", "Poses", poses,
            "Chosen so that they determine the parameters best; those kept out of the fit judge "
            "it."),
    Section("readings", "All readings", all_readings,
            "In the order in which they were taken; errors in mm.", folded=True),
)  # fmt: skip
