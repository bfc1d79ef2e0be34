"""Base class of the jobs: calibration, verification, payload, tool; and their outputs."""

from __future__ import annotations

import json
import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.bridge.calibration.instruments import INSTRUMENTS
from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument, InstrumentContext
from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.planning import effects_of, metrology_of
from gapbridge.bridge.calibration.session.prompt import Prompt
from gapbridge.bridge.calibration.session.reading_check import ReadingCheck
from gapbridge.bridge.calibration.session.session import Session
from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.document import read_document
from gapbridge.bridge.cell.saving import cell_text
from gapbridge.bridge.cell.verification_mark import read_mark, remove_mark, write_mark
from gapbridge.bridge.document.notes import note_text, short_text
from gapbridge.bridge.document.output_file import require_writable, write_table, write_together
from gapbridge.bridge.document.provenance import provenance
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.payload_session import PayloadCalibration
from gapbridge.core.calibration.plan import Expectation, Payload, Plan, PlannedPose
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.tool_session import ToolCalibration
from gapbridge.core.errors import InputError
from gapbridge.core.log.columns import as_table
from gapbridge.core.model import Model

NO_EXPECTATION = Expectation((), (), np.zeros(0), np.zeros(0), float("nan"), float("nan"))


class Job(ABC):
    """The purpose of one session: its plan, instrument, evaluation and output."""

    starts_at_current_pose = False  # the plan depends on the present joint angles
    suffix = "calibrated"  # of the new cell's default name

    def __init__(
        self, cell: Cell, options: SessionOptions, prompt: Prompt, session: Session
    ) -> None:
        self.cell, self.options, self.prompt, self.session = cell, options, prompt, session

    @property
    def folder(self) -> Path:
        """Return the session's folder."""
        return self.session.journal.path.parent

    @abstractmethod
    def plan(self, begin: Array | None, emit: Callable[[str, float], None]) -> Plan:
        """Return the plan; ``begin`` (n,) rad: present joint angles. Raises InputError."""

    @abstractmethod
    def report_plan(self, plan: Plan) -> None:
        """Print the plan and the accuracy to expect."""

    def instrument(self, context: InstrumentContext) -> AnyInstrument:
        """Return the instrument, not yet open."""
        return INSTRUMENTS[self.options.instrument.kind](self.options.instrument, context)

    def reading_check(self) -> ReadingCheck | None:
        """Return the check of each reading; None: readings are not checked one by one."""
        metrology, plan = metrology_of(self.cell, self.options.instrument), self.session.plan
        assert plan is not None
        return ReadingCheck(
            self.cell.model, metrology, self.options.instrument.measures, metrology.sigma,
            effects_of(self.cell), plan.loads, self.options.instrument.options,
        )  # fmt: skip

    @abstractmethod
    def finish(self) -> None:
        """Fit the readings, write the report, and write a new cell if the operator confirms."""

    def require_same_cell(self) -> None:
        """Raise InputError where the cell file was changed since the command read it.

        A session lasts for hours: a result of the old cell would undo the change, and name the
        SHA-256 of the new one as its origin.
        """
        path = self.cell.path
        if read_document(path).text != self.cell.document.text:
            raise InputError(
                f"{path}: found it changed since the command was started, expected the same: rerun "
                "it to evaluate the readings with the cell as it is now"
            )

    def report_short(
        self, result: PayloadCalibration | ToolCalibration, lines: Sequence[str],
        instrument: tuple[str, str],
    ) -> None:  # fmt: skip
        """Print the result of a short session, one line per estimate, and write its report.

        ``instrument``: its name and kind of reading.
        """
        from gapbridge.bridge.calibration.jobs.facts import session_facts
        from gapbridge.bridge.calibration.report import ShortSessionData, write_report

        prompt = self.prompt
        prompt.say()
        prompt.say(short_text(result), "bold")
        for line in (*lines, *(f"  note: {note_text(note)}" for note in result.notes)):
            prompt.say(line)
        facts = session_facts(self.cell, self.options, self.session, instrument)
        for file in write_report(ShortSessionData(result, facts, self.cell.model), self.folder):
            prompt.say(f"{file}: written")

    def write_new_cell(
        self, model: Model, what: str, sections: dict[str, Any] | None = None,
        baseline: dict[str, Any] | None = None,
    ) -> Path | None:  # fmt: skip
        """Ask, and write a new cell; the old one is kept. Returns its path, None if declined.

        ``baseline``: its accuracy baseline, written together with it. Raises RunError where the
        cell could not be loaded; then nothing is written.
        """
        cell, prompt = self.cell, self.prompt
        stem = cell.path.with_name(f"{cell.path.stem}_{self.suffix}{cell.path.suffix}")
        target = self.options.new_cell or _unused_path(stem)
        known = f", replacing the one there of {_modified_text(target)}" if target.exists() else ""
        prompt.say()
        question = f"Write {what} to {target}{known}? {cell.path} is not changed."
        if not self.options.yes and not prompt.confirm(question):
            self.session.add("ended", applied=None)
            prompt.say(f"nothing is applied; fit and report are kept in {self.folder}")
            return None
        self.require_same_cell()
        require_writable(target, cell.path)
        origin = provenance({"log": [self.session.journal.path], "cell": [cell.path]})
        kept = cell.file.provenance
        if kept is not None:  # the provenance of fitted parameters is kept
            kept_keys = {"fitted", "parameters", "covariance"}
            origin |= kept.model_dump(mode="json", include=kept_keys)
        text = cell_text(cell, target, model, {"provenance": origin} | (sections or {}))
        # the baseline first: were only it replaced, the old cell would fail its verification
        beside = {} if baseline is None else {baseline_path(target): document_text(baseline)}
        write_together({**beside, target: text})
        if baseline is not None:
            remove_mark(target)  # of the calibration that was replaced
        elif failed := read_mark(cell.path):  # the new cell has the same arm
            mark = write_mark(target, failed, self.folder)
            prompt.warn(f"{mark}: written, as the verification of {cell.path} failed")
        # last: a session that could not write all of it has not ended
        self.session.add("ended", applied=str(target.resolve()))
        prompt.say(f"{target}: written", "bold")
        return target


def short_plan(
    loads: tuple[Payload, ...],
    poses: list[PlannedPose],
    bought: Sequence[tuple[int, float]] = (),
    expected: Expectation = NO_EXPECTATION,
) -> Plan:
    """Return the plan of a verification or short session, without expected parameters."""
    return Plan(loads, tuple(poses), expected, tuple(bought), 0.0)


def baseline_path(cell: Path) -> Path:
    """Return the path of a cell's accuracy baseline; of a link, beside the file it leads to."""
    place = Path(os.path.realpath(cell))
    return place.with_name(f"{place.stem}.promise.json")


def document_text(document: dict[str, Any]) -> str:
    """Return a document as JSON."""
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def _modified_text(path: Path) -> str:
    return datetime.fromtimestamp(path.stat().st_mtime).strftime("%Y-%m-%d %H:%M")


def _unused_path(path: Path) -> Path:
    """Return the path, or the first numbered variant that does not exist."""
    names = [path, *(path.with_name(f"{path.stem}_{i}{path.suffix}") for i in range(2, 1000))]
    return next(p for p in names if not p.exists())


def write_log(readings: Readings, registered: bool, path: Path) -> None:
    """Write readings as a log (docs/logs.md), with the columns that were measured.

    A log has one frame: of an instrument that was moved, only the first station is written.
    """
    rows = readings if registered else readings[readings.station == 0]
    if rows.kind in ("position", "pose"):
        rows = rows[rows.target == 0]
    loads = rows.loads
    placed = rows.kind in ("position", "pose")
    columns = {
        "timestamp": np.arange(len(rows), dtype=float),
        "actual_q": rows.q,
        "payload": loads.payload_mass,
        "payload_cog": loads.payload_cog,
        "approach": loads.approach,
        "joint_temperatures": loads.temperature,
        "measured_position": rows.value[:, :3] if placed else None,
        "measured_rotation": rows.value[:, 3:] if rows.kind == "pose" else None,
    }
    write_table(path, *as_table(columns))
