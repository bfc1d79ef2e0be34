"""Verification: a few poses are measured to decide whether a calibration is still valid."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gapbridge.bridge.calibration.format import (
    change_text,
    duration,
    millimetres,
    quantity_text,
    verdict_text,
)
from gapbridge.bridge.calibration.jobs.job import Job, baseline_path, short_plan, write_log
from gapbridge.bridge.calibration.planning import (
    loads_of,
    metrology_of,
    observable_of,
    with_loads,
    workspace_of,
)
from gapbridge.bridge.calibration.session.session import seconds_left
from gapbridge.bridge.cell.verification_mark import mark_path, read_mark, remove_mark, write_mark
from gapbridge.bridge.document.notes import note_texts
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.accuracy_baseline import AccuracyBaseline, read_baseline
from gapbridge.core.calibration.plan import Plan, PlannedPose
from gapbridge.core.calibration.verify import Verification, verify
from gapbridge.core.errors import InputError, VerificationError
from gapbridge.core.planning.candidates import sample_candidates
from gapbridge.core.planning.travel import joint_speed, move_times, shortest_order, spread_rows

POSES = 10
MIN_POSES = 6  # as --poses: a calibration that few poses do not contradict need not hold


class VerifyJob(Job):
    """Compares poses across the workspace, under each load, with the accuracy baseline."""

    def _baseline(self) -> AccuracyBaseline:
        """Return the accuracy baseline of the calibration.

        Raises InputError if there is none, or that of another calibration.
        """
        path = baseline_path(self.cell.path)
        try:
            document = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            why = (
                "no such file" if isinstance(error, FileNotFoundError) else "none that can be read"
            )
            raise InputError(
                f"{path}: found {why}, expected the accuracy baseline that "
                "`gapbridge calibrate` writes beside a calibrated cell"
            ) from None
        if not isinstance(document, dict):
            raise InputError(f"{path}: found no mapping, expected an accuracy baseline")
        baseline, spread = read_baseline(document, str(path)), self.cell.spread
        if baseline.names != spread.names or not np.allclose(
            baseline.covariance, spread.covariance, rtol=1e-9, atol=0.0
        ):
            raise InputError(
                f"{path}: found the accuracy baseline of another calibration, expected that of "
                f"{self.cell.path}: its `parameters` and `covariance` are those of `provenance`"
            )
        return baseline

    def plan(self, begin: Array | None, emit: Callable[[str, float], None]) -> Plan:
        """Return poses far apart from each other, in the order of travel, load by load."""
        baseline = self._baseline()
        if baseline.kind != self.options.instrument.measures:
            raise InputError(
                f"{baseline_path(self.cell.path)}: found a calibration by {baseline.kind}, "
                f"expected one by {self.options.instrument.measures}: verify it as it was made"
            )
        loads = tuple(sorted(loads_of(self.cell), key=lambda load: load.mass))
        workspace = with_loads(workspace_of(self.cell, baseline.kind), loads)
        workspace = replace(workspace, places=workspace.places[:1])  # a few poses from one place
        observable = observable_of(self.cell, self.options.instrument)
        emit("looking for poses", 0.2)
        candidates = sample_candidates(
            baseline.parameters(self.cell.model), observable, loads, workspace, self.options.seed
        )
        count = min(self.options.poses or POSES, len(candidates.q))
        chosen = spread_rows(self.cell.model.rigid_pose(candidates.q).position, count)
        speed = joint_speed(self.cell.arm.limits.velocity)
        poses: list[PlannedPose] = []
        for load, part in enumerate(np.array_split(chosen, len(loads))):
            q = candidates.q[part]
            order = shortest_order(move_times(q, q, speed), np.zeros(len(q)))
            approach = np.zeros(q.shape[1])  # any
            poses += [
                PlannedPose(len(poses) + i, q[k], load, approach, held_out=True)
                for i, k in enumerate(order)
            ]
        return short_plan(loads, poses)

    def report_plan(self, plan: Plan) -> None:
        """Print the number of stops and the estimated duration."""
        time = seconds_left(self.session, self.cell.calibration.minutes_per_load)
        self.prompt.say(f"plan: {len(plan.poses)} poses, {duration(time)}")

    def finish(self) -> None:
        """Report whether the calibration is still valid, and what has changed if it is not.

        Raises VerificationError if it is not, InputError if too few poses were measured. New
        readings set or remove the mark beside the cell; a session that is only evaluated once more
        does not.
        """
        prompt, options, folder = self.prompt, self.options, self.folder
        places = self.session.station_count
        metrology = metrology_of(self.cell, options.instrument, places)
        readings = self.session.all_readings(options.instrument.measures)
        if (count := len(np.unique(readings.pose))) < MIN_POSES:
            raise InputError(
                f"verification: found {count} poses measured, expected at least {MIN_POSES}: fewer "
                "hardly show what has changed; measure them in another --session"
            )
        with prompt.waiting("comparing"):
            verification = verify(
                self.cell.model, readings, self._baseline(), metrology,
                observable=observable_of(self.cell, options.instrument, places),
            )  # fmt: skip
        if not self.session.has_ended:
            self._mark(verification)  # first: whatever fails below, the daemon must not arm
        prompt.say()
        self._report(verification)
        write_log(readings, metrology.registered, folder / "readings.csv")
        from gapbridge.bridge.calibration.jobs.facts import session_facts
        from gapbridge.bridge.calibration.report import VerificationData, write_report

        facts = session_facts(self.cell, options, self.session)
        for file in write_report(VerificationData(verification, facts, readings), folder):
            prompt.say(f"{file}: written")
        moved = None if verification.moved is None else verification.moved.name
        others = [other.name for other in verification.alternatives]
        self.session.add("ended", holds=verification.holds, moved=moved, or_else=others)
        if not verification.holds:
            raise VerificationError(f"{self.cell.path}: {verdict_text(verification)}")

    def _mark(self, verification: Verification) -> None:
        """Mark the cell, so that its daemon does not arm, or remove the mark. Raises RunError."""
        path, prompt = self.cell.path, self.prompt
        if verification.cell_differs:
            mark = write_mark(path, verdict_text(verification), self.folder)
            prompt.warn(
                f"{mark}: written; `gapbridge run {path}` does not arm until a "
                f"verification passes, or a person has acknowledged it: gapbridge disarm {path}"
            )
        elif (
            verification.holds and self.cell.metrology.registered and self.session.station_count > 1
        ):
            if read_mark(path):  # it may be of joint 1, which shows from a registered place only
                prompt.warn(
                    f"{mark_path(path)}: kept: the instrument was moved, so that a turn of the "
                    "whole arm does not show; verify again from one place"
                )
        elif verification.holds and remove_mark(path):
            prompt.say(f"{mark_path(path)}: removed")

    def _report(self, verification: Verification) -> None:
        prompt = self.prompt
        prompt.say(verdict_text(verification), "bold green" if verification.holds else "bold red")
        prompt.say(
            f"  errors {millimetres(verification.errors.mean)} mean, "
            f"{millimetres(verification.errors.max)} at most; {verification.ratio:.2f} times what "
            "was predicted"
        )
        moved = verification.moved
        if moved is not None and moved.reading is not None:
            stop = self.session.accepted[moved.reading - 1].stop + 1
            prompt.say(f"  reading {moved.reading} is of stop {stop}")
        for estimate in () if verification.moved is None else verification.moved.estimates:
            prompt.say(
                f"  {estimate.name} {quantity_text(estimate.value, estimate.unit)} "
                f"± {quantity_text(estimate.std, estimate.unit)}"
            )
        for other in verification.alternatives:
            prompt.say(f"  these readings cannot distinguish it from: {change_text(other)}")
        for note in note_texts(verification.notes):
            prompt.say(f"  note: {note}")
