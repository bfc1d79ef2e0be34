"""What differs between a whole calibration, a verification and the short sessions."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.bridge.calibration.instruments import INSTRUMENTS
from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument, Surroundings
from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.planning import effects_of, loads_of, metrology_of
from gapbridge.bridge.calibration.session.prompt import Prompt
from gapbridge.bridge.calibration.session.reading_check import ReadingCheck
from gapbridge.bridge.calibration.session.session import Session
from gapbridge.bridge.cell import Cell, save_cell
from gapbridge.bridge.document.notes import note_text, short_text
from gapbridge.bridge.document.output_file import require_writable, write_table, write_text
from gapbridge.bridge.document.provenance import provenance
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.payload_session import PayloadCalibration
from gapbridge.core.calibration.plan import Expectation, Payload, Plan, PlannedPose
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.tool_session import ToolCalibration
from gapbridge.core.model import Model

NO_EXPECTATION = Expectation((), (), np.zeros(0), np.zeros(0), float("nan"), float("nan"))


class Job(ABC):
    """One session's purpose: what is planned, what measures, and what becomes of it."""

    from_here = False  # the plan begins where the arm stands now
    suffix = "calibrated"  # of the new cell's name, where none is given

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
        """Return the plan. Raises InputError where there can be none."""

    @abstractmethod
    def report_plan(self, plan: Plan) -> None:
        """Say what is planned, and what it will determine."""

    def instrument(self, around: Surroundings) -> AnyInstrument:
        """Return what measures, not yet open."""
        return INSTRUMENTS[self.options.instrument.kind](self.options.instrument, around)

    def reading_check(self) -> ReadingCheck | None:
        """Return who judges the readings; None: nobody can."""
        metrology = metrology_of(self.cell, self.options.instrument)
        return ReadingCheck(
            self.cell.model, metrology, self.options.instrument.measures, metrology.sigma,
            effects_of(self.cell), loads_of(self.cell), self.options.instrument.options,
        )  # fmt: skip

    @abstractmethod
    def finish(self) -> None:
        """Work out what the readings determine, report it, and apply it where a person says so."""

    def report_short(
        self, found: PayloadCalibration | ToolCalibration, lines: Sequence[str],
        instrument: tuple[str, str],
    ) -> None:  # fmt: skip
        """Say what a short session found, a line an estimate, and write its report.

        ``instrument``: name and kind of what was measured with.
        """
        from gapbridge.bridge.calibration.jobs.facts import session_facts
        from gapbridge.bridge.calibration.report import ShortMaterial, write_report

        prompt = self.prompt
        prompt.say()
        prompt.say(short_text(found), "bold")
        for line in (*lines, *(f"  note: {note_text(note)}" for note in found.notes)):
            prompt.say(line)
        facts = session_facts(self.cell, self.options, self.session, instrument)
        for file in write_report(ShortMaterial(found, facts, self.cell.model), self.folder):
            prompt.say(f"{file}: written")

    def hand_over(
        self, model: Model, what: str, sections: dict[str, Any] | None = None
    ) -> Path | None:
        """Ask, and write the new cell; the old one stays. Returns where it was written."""
        cell, prompt = self.cell, self.prompt
        stem = cell.path.with_name(f"{cell.path.stem}_{self.suffix}{cell.path.suffix}")
        target = self.options.new_cell or _free(stem)
        known = f", replacing the one there of {_since(target)}" if target.exists() else ""
        prompt.say()
        question = f"Write {what} to {target}{known}? {cell.path} is not changed."
        if not self.options.yes and not prompt.confirm(question):
            self.session.add("ended", applied=None)
            prompt.say(f"nothing is applied; fit and report are kept in {self.folder}")
            return None
        require_writable(target, cell.path)
        origin = provenance({"log": [self.session.journal.path], "cell": [cell.path]})
        kept = cell.file.provenance
        if kept is not None:  # what was fitted of the arm stays as it was
            kept_keys = {"fitted", "parameters", "covariance"}
            origin |= kept.model_dump(mode="json", include=kept_keys)
        save_cell(cell, target, model, {"provenance": origin} | (sections or {}))
        self.session.add("ended", applied=str(target.resolve()))
        prompt.say(f"{target}: written", "bold")
        return target


def bare_plan(
    loads: tuple[Payload, ...],
    poses: list[PlannedPose],
    bought: Sequence[tuple[int, float]] = (),
    expected: Expectation = NO_EXPECTATION,
) -> Plan:
    """Return a plan of a short session, of which no parameters of the arm are expected."""
    return Plan(loads, tuple(poses), expected, tuple(bought), 0.0)


def write_document(path: Path, document: dict[str, Any]) -> None:
    """Write a document as JSON."""
    write_text(path, json.dumps(document, indent=1, allow_nan=False) + "\n")


def _since(path: Path) -> str:
    return datetime.fromtimestamp(path.stat().st_mtime).strftime("%Y-%m-%d %H:%M")


def _free(path: Path) -> Path:
    """Return the path, or the first numbered one beside it that is free."""
    names = [path, *(path.with_name(f"{path.stem}_{i}{path.suffix}") for i in range(2, 1000))]
    return next(p for p in names if not p.exists())


def write_log(readings: Readings, registered: bool, path: Path) -> None:
    """Write readings in a log's columns; those that an instrument did not give are left out.

    A log has one frame: of an instrument that was moved, rows of its first place alone are written.
    """
    rows = readings if registered else readings[readings.station == 0]
    if rows.kind in ("position", "pose"):
        rows = rows[rows.target == 0]
    n, loads = rows.q.shape[1], rows.loads
    columns: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.float64]]] = {
        "timestamp": np.arange(len(rows), dtype=float),
        **{f"actual_q_{i}": rows.q[:, i] for i in range(n)},
    }
    if loads.payload_mass is not None and loads.payload_cog is not None:
        columns["payload"] = loads.payload_mass
        columns |= {f"payload_cog_{i}": loads.payload_cog[:, i] for i in range(3)}
    if loads.approach is not None:
        columns |= {f"approach_{i}": loads.approach[:, i] for i in range(n)}
    if loads.temperature is not None:
        columns |= {f"joint_temperatures_{i}": loads.temperature[:, i] for i in range(n)}
    if rows.kind in ("position", "pose"):
        columns |= {f"measured_position_{i}": rows.value[:, i] for i in range(3)}
    if rows.kind == "pose":
        columns |= {f"measured_rotation_{i}": rows.value[:, 3 + i] for i in range(3)}
    write_table(path, list(columns), np.column_stack(list(columns.values())))
