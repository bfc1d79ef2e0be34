"""Short sessions that start at the present pose and turn the wrist: a new tool, a new payload.

`--tool-only`: the TCP, from the tool's tip at one fixed point in several orientations.
`--payload-only`: the payload, from the flange's force-torque sensor in a few orientations.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gapbridge.bridge.calibration.format import millimetres, number_text
from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument, InstrumentContext
from gapbridge.bridge.calibration.instruments.joint_only import FlangeSensor, PointContact
from gapbridge.bridge.calibration.jobs.job import Job, short_plan
from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.planning import own_load, with_loads, workspace_of
from gapbridge.bridge.calibration.session.prompt import Prompt
from gapbridge.bridge.calibration.session.reading_check import ReadingCheck
from gapbridge.bridge.calibration.session.session import Session
from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.settings.instruments import Base, PointSettings
from gapbridge.bridge.document.notes import note_text
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.payload_session import (
    NAMES,
    UNITS,
    PayloadCalibration,
    calibrate_payload,
)
from gapbridge.core.calibration.plan import Expectation, Plan, PlannedPose
from gapbridge.core.calibration.tool_session import calibrate_tool
from gapbridge.core.notes import Reason
from gapbridge.core.planning.payload_plan import plan_payload
from gapbridge.core.planning.tool_plan import plan_tool
from gapbridge.core.rotation import roll_pitch_yaw

POSES = 6
MIN_DECLARED = 0.3  # kg, of a cell, that a sensor does not overlook
FORCE_UNITS = {"lbf": 4.4482, "kgf": 9.80665, "kN": 1e3, "ozf": 0.27801}  # N
UNIT_MATCH = 0.03  # of the declared mass, by which a unit is recognised


class _ShortJob(Job):
    """A job of a few orientations; readings are checked by the final fit only."""

    starts_at_current_pose = True

    def reading_check(self) -> ReadingCheck | None:
        """Return None: a few orientations give no redundancy to check single readings."""
        return None


def _planned_poses(q: Sequence[Array]) -> list[PlannedPose]:
    """Return orientations, each (n,) rad, as the poses of a plan, all under the first load."""
    return [PlannedPose(i, row, 0, np.zeros(len(row))) for i, row in enumerate(q)]


class ToolJob(_ShortJob):
    """Identifies the tool centre point from joint angles alone."""

    suffix = "tool"

    def __init__(
        self, cell: Cell, options: SessionOptions, prompt: Prompt, session: Session
    ) -> None:
        if cell.calibration.joints == "planned":
            raise cell.error(
                ("calibration", "joints"),
                "found 'planned', expected 'link' or 'typed': the tip is brought onto the point by "
                "hand",
            )
        super().__init__(cell, options, prompt, session)

    def plan(self, begin: Array | None, emit: Callable[[str, float], None]) -> Plan:
        """Return orientations about the present position of the tip."""
        assert begin is not None
        result = plan_tool(
            self.cell.model, begin, poses=self.options.poses or POSES, seed=self.options.seed
        )
        load = own_load(self.cell, "the tool, as in the cell")  # not a load of a calibration
        return short_plan((load,), _planned_poses(result.poses), result.bought)

    def report_plan(self, plan: Plan) -> None:
        """Print the number of contacts and the expected accuracy of the TCP."""
        expected = f"; expected ±{millimetres(plan.bought[-1][1])}" if plan.bought else ""
        self.prompt.say(f"plan: the tip onto one fixed point {len(plan.poses)} times{expected}")

    def instrument(self, context: InstrumentContext) -> AnyInstrument:
        """Return the contact with the fixed point."""
        return PointContact(PointSettings(kind="point"), context)

    def finish(self) -> None:
        """Report the TCP and, if confirmed, write it into a new cell."""
        model = self.cell.model
        readings = self.session.readings("point")
        result = calibrate_tool(model, readings.q, readings.loads)
        lines = [
            f"  {e.name:<11} {millimetres(e.value)}  "
            f"(95 %: {millimetres(e.interval[0])} to {millimetres(e.interval[1])})"
            for e in result.estimates
        ]
        self.report_short(result, lines, ("tip on a fixed point", "touch"))
        applied = result.applied(model)
        tcp = {
            "xyz": [float(v) for v in applied.tool_in_flange[:3, 3]],
            "rpy": [float(v) for v in roll_pitch_yaw(applied.tool_in_flange[:3, :3])],
        }
        self.write_new_cell(applied, "the cell with this tool", {"tool": {"tcp": tcp}})


class PayloadJob(_ShortJob):
    """Identifies mass and centre of gravity of the payload, and the sensor's bias."""

    suffix = "loaded"

    def __init__(
        self, cell: Cell, options: SessionOptions, prompt: Prompt, session: Session
    ) -> None:
        if cell.link is None or cell.calibration.joints not in (None, "link"):
            raise cell.error(
                ("link",),
                "found nothing to read ft_raw_wrench from, expected a controller, and "
                "calibration.joints: link",
            )
        super().__init__(cell, options, prompt, session)

    def plan(self, begin: Array | None, emit: Callable[[str, float], None]) -> Plan:
        """Return orientations of the flange about the present pose."""
        assert begin is not None
        load = own_load(self.cell, "to be identified; declared")
        workspace = with_loads(workspace_of(self.cell, "position"), [load])
        result = plan_payload(
            self.cell.model, begin, poses=self.options.poses, seed=self.options.seed,
            workspace=workspace,
        )  # fmt: skip
        expected = Expectation(
            NAMES, UNITS, result.std, np.full(len(result.std), np.nan), np.nan, np.nan
        )
        return short_plan((load,), _planned_poses(result.poses), expected=expected)

    def report_plan(self, plan: Plan) -> None:
        """Print the number of orientations and the expected accuracy of the payload."""
        rows = zip(plan.expected.names, plan.expected.units, plan.expected.std, strict=True)
        spreads = ", ".join(f"{n} ±{number_text(s)} {u}" for n, u, s in list(rows)[:4])
        self.prompt.say(f"plan: {len(plan.poses)} orientations; expected {spreads}")

    def instrument(self, context: InstrumentContext) -> AnyInstrument:
        """Return the flange's force-torque sensor."""
        return FlangeSensor(Base(), context)

    def finish(self) -> None:
        """Report payload and sensor bias; if confirmed, write the payload into a new cell."""
        readings = self.session.accepted
        q = np.array([r.q for r in readings])
        wrench = np.array([r.raw_wrench for r in readings])
        result = calibrate_payload(self.cell.model, q, wrench)
        lines = [
            f"  {e.name:<14} {number_text(e.value)} {e.unit}  "
            f"(95 %: {number_text(e.interval[0])} to {number_text(e.interval[1])})"
            for e in result.estimates
        ]
        self.report_short(result, lines, ("the force sensor of the flange", "wrench"))
        if why := self._why_not(result):
            self.session.add("ended", applied=None)
            self.prompt.warn(f"nothing is applied: {why}")
            return
        if unit := _unit_instead_of_newtons(result.mass, self.cell.file.payload.mass):
            self.prompt.warn(
                f"{number_text(result.mass)} kg instead of the cell's "
                f"{self.cell.file.payload.mass:g} kg: does the sensor read {unit}? expected N"
            )
        applied = result.applied(self.cell.model)
        payload = {"mass": applied.payload_mass, "cog": [float(v) for v in applied.payload_cog]}
        self.write_new_cell(applied, "the cell with this load", {"payload": payload})

    def _why_not(self, result: PayloadCalibration) -> str:
        """Return why the payload is not written; empty: it may be."""
        declared = self.cell.file.payload.mass
        for note in result.notes:
            if note.reason is Reason.NEGATIVE_MASS:
                return note_text(note)
            if note.reason is Reason.NOTHING_WEIGHS and declared > MIN_DECLARED:
                return (
                    f"the sensor finds no load, the cell declares {declared:g} kg: are its "
                    "readings raw and in flange axes? A bare flange has payload.mass: 0 in the cell"
                )
        return ""


def _unit_instead_of_newtons(mass: float, declared: float) -> str:
    """Return the unit of force in which a sensor would weigh ``declared`` kg as ``mass``."""
    return next(
        (
            unit
            for unit, newtons in FORCE_UNITS.items()
            if declared > 0.0 and abs(mass * newtons / declared - 1.0) < UNIT_MATCH
        ),
        "",
    )
