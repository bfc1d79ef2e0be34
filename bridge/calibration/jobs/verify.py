"""Months later: a few poses measured again show whether the calibration still holds."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from gapbridge.bridge.calibration.format import (
    duration,
    millimetres,
    moved_text,
    parameter,
    verdict_text,
)
from gapbridge.bridge.calibration.jobs.calibrate import baseline_beside
from gapbridge.bridge.calibration.jobs.job import Job, bare_plan, write_log
from gapbridge.bridge.calibration.planning import (
    loads_of,
    metrology_of,
    observable_of,
    space_of,
    with_loads,
)
from gapbridge.bridge.calibration.session.session import seconds_left
from gapbridge.bridge.document.notes import note_texts
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.accuracy_baseline import read_baseline
from gapbridge.core.calibration.plan import Plan, PlannedPose
from gapbridge.core.calibration.verify import Verification, verify
from gapbridge.core.errors import InputError
from gapbridge.core.planning.candidates import sample_candidates
from gapbridge.core.planning.travel import joint_speed, move_times, shortest_order, spread_rows

POSES = 10


class VerifyJob(Job):
    """Poses all over the workspace, under each load; nothing is fitted but the instrument."""

    def _baseline(self) -> dict[str, Any]:
        """Return the calibration's accuracy baseline. Raises InputError where nobody knows."""
        path = baseline_beside(self.cell.path)
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            why = (
                "no such file" if isinstance(error, FileNotFoundError) else "none that can be read"
            )
            raise InputError(
                f"{path}: found {why}, expected the accuracy baseline that "
                "`gapbridge calibrate` writes beside a calibrated cell"
            ) from None
        if not isinstance(found, dict):
            raise InputError(f"{path}: found no mapping, expected an accuracy baseline")
        return found

    def plan(self, begin: Array | None, emit: Callable[[str, float], None]) -> Plan:
        """Return poses far from each other."""
        baseline = read_baseline(self._baseline())
        if baseline.kind != self.options.instrument.measures:
            raise InputError(
                f"{baseline_beside(self.cell.path)}: found a calibration by {baseline.kind}, "
                f"expected one by {self.options.instrument.measures}: verify it as it was made"
            )
        loads = tuple(sorted(loads_of(self.cell), key=lambda load: load.mass))
        space = with_loads(space_of(self.cell, baseline.kind), loads)
        space = replace(space, places=space.places[:1])  # a few poses from one place
        observable = observable_of(self.cell, self.options.instrument)
        emit("looking for poses", 0.2)
        found = sample_candidates(
            baseline.parameters(self.cell.model), observable, loads, space, self.options.seed
        )
        count = min(self.options.poses or POSES, len(found.q))
        chosen = spread_rows(self.cell.model.rigid_pose(found.q).position, count)
        speed = joint_speed(self.cell.arm.limits.velocity)
        poses: list[PlannedPose] = []
        for load, part in enumerate(np.array_split(chosen, len(loads))):
            q = found.q[part]
            way = shortest_order(move_times(q, q, speed), np.zeros(len(q)))
            free = np.zeros(q.shape[1])
            poses += [
                PlannedPose(len(poses) + i, q[k], load, free, held_out=True)
                for i, k in enumerate(way)
            ]
        return bare_plan(loads, poses)

    def report_plan(self, plan: Plan) -> None:
        """Say how many stops there are."""
        left = seconds_left(self.session, self.cell.calibration.minutes_per_load)
        self.prompt.say(f"plan: {len(plan.poses)} poses, {duration(left)}")

    def finish(self) -> None:
        """Say whether the calibration holds, and report it."""
        prompt, options, folder = self.prompt, self.options, self.folder
        places = self.session.places
        metrology = metrology_of(self.cell, options.instrument, places)
        readings = self.session.all_readings(options.instrument.measures)
        with prompt.waiting("comparing"):
            found = verify(
                self.cell.model, readings, self._baseline(), metrology,
                observable=observable_of(self.cell, options.instrument, places),
            )  # fmt: skip
        prompt.say()
        self._report(found)
        write_log(readings, metrology.registered, folder / "readings.csv")
        from gapbridge.bridge.calibration.jobs.facts import session_facts
        from gapbridge.bridge.calibration.report import VerificationMaterial, write_report

        facts = session_facts(self.cell, options, self.session)
        for file in write_report(VerificationMaterial(found, facts, readings), folder):
            prompt.say(f"{file}: written")
        moved = None if found.moved is None else found.moved.name
        others = [other.name for other in found.alternatives]
        self.session.add("ended", holds=found.holds, moved=moved, or_else=others)

    def _report(self, found: Verification) -> None:
        prompt = self.prompt
        prompt.say(verdict_text(found), "bold green" if found.holds else "bold red")
        prompt.say(
            f"  errors {millimetres(found.errors.mean)} mean, "
            f"{millimetres(found.errors.max)} at most; {found.ratio:.2f} times what was predicted"
        )
        for estimate in () if found.moved is None else found.moved.estimates:
            prompt.say(
                f"  {estimate.name} {parameter(estimate.value, estimate.unit)} "
                f"± {parameter(estimate.std, estimate.unit)}"
            )
        for other in found.alternatives:
            prompt.say(f"  these readings cannot distinguish it from: {moved_text(other)}")
        for note in note_texts(found.notes):
            prompt.say(f"  note: {note}")
