"""Readings are checked against the loads of the plan, in its order."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gapbridge.bridge.calibration.jobs.calibrate import CalibrationJob
from gapbridge.bridge.calibration.jobs.job import short_plan
from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.session.journal import Journal
from gapbridge.bridge.calibration.session.prompt import Prompt
from gapbridge.bridge.calibration.session.session import Session
from gapbridge.bridge.cell import load_cell
from gapbridge.core.calibration.plan import Payload, PlannedPose


def test_loads_that_a_cell_lists_heaviest_first_are_numbered_as_in_the_plan(tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_text(
        "robot: {model: ur10e}\ncalibration: {loads: [{mass: 9.0}, {mass: 1.0}]}\n",
        encoding="utf-8",
    )
    cell, loads = load_cell(tmp_path / "cell.yaml"), (Payload(1.0), Payload(9.0))
    with Journal(tmp_path / "s") as journal:
        session = Session.of(journal)
        session.add_plan(short_plan(loads, [PlannedPose(0, np.zeros(6), 1, np.zeros(6))]))
        options = SessionOptions("whole", None, cell.calibration.instrument)
        check = CalibrationJob(cell, options, Prompt(), session).reading_check()
    assert check is not None
    assert check._loads == loads
