"""`--payload-only`: what hangs on the flange, from the force sensor in a few orientations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gapbridge.bridge.calibration.format import figure
from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument, Surroundings
from gapbridge.bridge.calibration.instruments.joints_alone import FlangeSensor
from gapbridge.bridge.calibration.jobs.job import Job, bare_plan
from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.session.prompt import Prompt
from gapbridge.bridge.calibration.session.reading_check import ReadingCheck
from gapbridge.bridge.calibration.session.session import Session
from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.settings.instruments import Base
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.payload_session import calibrate_payload
from gapbridge.core.calibration.plan import Expectation, Payload, Plan, PlannedPose
from gapbridge.core.errors import CellError
from gapbridge.core.planning.payload_plan import plan_payload


class PayloadJob(Job):
    """Mass, centre of gravity and the sensor's bias; the wrist turns where the arm stands."""

    from_here = True
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
        free = np.zeros(len(begin))
        poses = [PlannedPose(i, q, 0, free) for i, q in enumerate(found.poses)]
        expected = Expectation(
            found.names, found.units, found.std, np.full(len(found.std), np.nan), np.nan, np.nan
        )
        return bare_plan((load,), poses, expected=expected)

    def report_plan(self, plan: Plan) -> None:
        """Say how many orientations there are, and how well they will determine the load."""
        rows = zip(plan.expected.names, plan.expected.units, plan.expected.std, strict=True)
        spreads = ", ".join(f"{n} ±{figure(s)} {u}" for n, u, s in list(rows)[:4])
        self.prompt.say(f"plan: {len(plan.poses)} orientations; expected {spreads}")

    def instrument(self, around: Surroundings) -> AnyInstrument:
        """Return the flange's own sensor."""
        return FlangeSensor(Base(), around)

    def reading_check(self) -> ReadingCheck | None:
        """Return nobody: ten unknowns of a few orientations are judged at the end."""
        return None

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
