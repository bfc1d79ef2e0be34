"""Short sessions that begin where the arm stands and turn the wrist: a new tool, a new payload.

`--tool-only`: the tip of the tool, brought onto one fixed point from several orientations.
`--payload-only`: what hangs on the flange, from the force sensor in a few orientations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gapbridge.bridge.calibration.format import figure, millimetres
from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument, Surroundings
from gapbridge.bridge.calibration.instruments.joints_alone import FlangeSensor, TipOnPoint
from gapbridge.bridge.calibration.jobs.job import Job, bare_plan
from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.planning import loads_of
from gapbridge.bridge.calibration.session.prompt import Prompt
from gapbridge.bridge.calibration.session.reading_check import ReadingCheck
from gapbridge.bridge.calibration.session.session import Session
from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.settings.instruments import Base, PointSettings
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.payload_session import calibrate_payload
from gapbridge.core.calibration.plan import Expectation, Payload, Plan, PlannedPose
from gapbridge.core.calibration.tool_session import calibrate_tool
from gapbridge.core.errors import CellError
from gapbridge.core.planning.payload_plan import plan_payload
from gapbridge.core.planning.tool_plan import plan_tool
from gapbridge.core.rotation import roll_pitch_yaw

POSES = 6


class _ShortJob(Job):
    """A job of a few orientations, judged at the end alone."""

    from_here = True

    def reading_check(self) -> ReadingCheck | None:
        """Return nobody: there are as many unknowns as a few orientations determine."""
        return None


def _planned(q: Sequence[Array]) -> list[PlannedPose]:
    """Return orientations, each (n,) rad, as the poses of a plan, all under the first load."""
    return [PlannedPose(i, row, 0, np.zeros(len(row))) for i, row in enumerate(q)]


class ToolJob(_ShortJob):
    """The tool centre point from joint angles alone."""

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
        return bare_plan(loads_of(self.cell)[:1], _planned(found.poses), found.bought)

    def report_plan(self, plan: Plan) -> None:
        """Say how many touches there are, and how well they will determine the tip."""
        expected = f"; expected ±{millimetres(plan.bought[-1][1])}" if plan.bought else ""
        self.prompt.say(f"plan: the tip onto one fixed point {len(plan.poses)} times{expected}")

    def instrument(self, around: Surroundings) -> AnyInstrument:
        """Return the fixed point."""
        return TipOnPoint(PointSettings(kind="point"), around)

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


class PayloadJob(_ShortJob):
    """Mass, centre of gravity and the sensor's bias; the wrist turns where the arm stands."""

    suffix = "loaded"

    def __init__(
        self, cell: Cell, options: SessionOptions, prompt: Prompt, session: Session
    ) -> None:
        if cell.link is None or cell.calibration.joints not in (None, "link"):
            raise CellError(
                f"{cell.path}: link: found nothing to read ft_raw_wrench from, expected a "
                "controller, and calibration.joints: link"
            )
        super().__init__(cell, options, prompt, session)

    def plan(self, begin: Array | None, emit: Callable[[str, float], None]) -> Plan:
        """Return orientations of the flange around where the arm stands."""
        assert begin is not None
        own = self.cell.file.payload
        load = Payload(own.mass, (own.cog[0], own.cog[1], own.cog[2]), "to be weighed; so far")
        found = plan_payload(
            self.cell.model, begin, poses=self.options.poses, seed=self.options.seed
        )
        expected = Expectation(
            found.names, found.units, found.std, np.full(len(found.std), np.nan), np.nan, np.nan
        )
        return bare_plan((load,), _planned(found.poses), expected=expected)

    def report_plan(self, plan: Plan) -> None:
        """Say how many orientations there are, and how well they will determine the load."""
        rows = zip(plan.expected.names, plan.expected.units, plan.expected.std, strict=True)
        spreads = ", ".join(f"{n} ±{figure(s)} {u}" for n, u, s in list(rows)[:4])
        self.prompt.say(f"plan: {len(plan.poses)} orientations; expected {spreads}")

    def instrument(self, around: Surroundings) -> AnyInstrument:
        """Return the flange's own sensor."""
        return FlangeSensor(Base(), around)

    def finish(self) -> None:
        """Report mass, centre of gravity and bias, and write them into a new cell after a yes."""
        taken = self.session.taken
        q = np.array([t.q for t in taken])
        wrench = np.array([t.raw_wrench for t in taken])
        found = calibrate_payload(self.cell.model, q, wrench)
        lines = [
            f"  {e.name:<14} {figure(e.value)} {e.unit}  "
            f"(95 %: {figure(e.interval[0])} to {figure(e.interval[1])})"
            for e in found.estimates
        ]
        self.report_short(found, lines, ("the force sensor of the flange", "wrench"))
        payload = {"mass": found.mass, "cog": [float(v) for v in found.cog]}
        self.hand_over(
            found.applied(self.cell.model), "the cell with this load", {"payload": payload}
        )
