"""`--tool-only`: the tip of a new tool, brought onto one fixed point from several orientations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gapbridge.bridge.calibration.format import millimetres
from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument, Surroundings
from gapbridge.bridge.calibration.instruments.joints_alone import TipOnPoint
from gapbridge.bridge.calibration.jobs.job import Job, bare_plan
from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.planning import loads_of
from gapbridge.bridge.calibration.session.prompt import Prompt
from gapbridge.bridge.calibration.session.reading_check import ReadingCheck
from gapbridge.bridge.calibration.session.session import Session
from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.settings.instruments import PointSettings
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import Plan, PlannedPose
from gapbridge.core.calibration.tool_session import calibrate_tool
from gapbridge.core.errors import CellError
from gapbridge.core.planning.tool_plan import plan_tool
from gapbridge.core.rotation import roll_pitch_yaw

POSES = 6


class ToolJob(Job):
    """The tool centre point from joint angles alone."""

    from_here = True
    suffix = "tool"

    def __init__(
        self, cell: Cell, options: SessionOptions, prompt: Prompt, session: Session
    ) -> None:
        if cell.calibration.joints == "planned":
            raise CellError(
                f"{cell.path}: calibration.joints: found 'planned', expected 'link' or 'typed': "
                "the tip is brought onto the point by hand"
            )
        super().__init__(cell, options, prompt, session)

    def plan(self, begin: Array | None, emit: Callable[[str, float], None]) -> Plan:
        """Return orientations about where the tip is now."""
        assert begin is not None
        found = plan_tool(
            self.cell.model, begin, poses=self.options.poses or POSES, seed=self.options.seed
        )
        free = np.zeros(len(begin))
        poses = [PlannedPose(i, q, 0, free) for i, q in enumerate(found.poses)]
        return bare_plan(loads_of(self.cell)[:1], poses, found.bought)

    def report_plan(self, plan: Plan) -> None:
        """Say how many touches there are, and how well they will determine the tip."""
        expected = f"; expected ±{millimetres(plan.bought[-1][1])}" if plan.bought else ""
        self.prompt.say(f"plan: the tip onto one fixed point {len(plan.poses)} times{expected}")

    def instrument(self, around: Surroundings) -> AnyInstrument:
        """Return the fixed point."""
        return TipOnPoint(PointSettings(kind="point"), around)

    def reading_check(self) -> ReadingCheck | None:
        """Return nobody: the touches are judged at the end."""
        return None

    def finish(self) -> None:
        """Report where the tip is, and write it into a new cell after a yes."""
        model = self.cell.model
        readings = self.session.readings("point")
        found = calibrate_tool(model, readings.q, readings.loads)
        lines = [
            f"  {e.name:<11} {millimetres(e.value)}  "
            f"(95 %: {millimetres(e.interval[0])} to {millimetres(e.interval[1])})"
            for e in found.estimates
        ]
        self.report_short(found, lines, ("tip on a fixed point", "touch"))
        applied = found.applied(model)
        tcp = {
            "xyz": [float(v) for v in applied.tool_in_flange[:3, 3]],
            "rpy": [float(v) for v in roll_pitch_yaw(applied.tool_in_flange[:3, :3])],
        }
        self.hand_over(applied, "the cell with this tool", {"tool": {"tcp": tcp}})
