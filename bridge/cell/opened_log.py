"""Opening a log for a cell: number of joints, units and payloads are checked."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from gapbridge.bridge.cell.cell import Cell
from gapbridge.bridge.document.notes import note_texts
from gapbridge.core.diagnosis.log_checks.units_and_clocks import check_units
from gapbridge.core.errors import LogError, LogOptionError
from gapbridge.core.load_bounds import PAYLOAD_FACTOR, WRENCH, LoadBounds
from gapbridge.core.log.log import Log, read_log
from gapbridge.core.log.sources import SourceOptions, source_of
from gapbridge.core.notes import Note
from gapbridge.core.rotation import rotation_matrix, rotation_vector


def open_log(path: Path, cell: Cell) -> Log:
    """Return a log for a cell's arm: a CSV or Parquet file, or another source (core.log.sources).

    Raises LogError if a payload is out of range, angles look like degrees or positions like
    millimetres.
    """
    source = source_of(path)
    if source is None:
        log = read_log(path, cell.arm.n)
    else:
        try:
            converted = source.read(path, joint_names(cell), SourceOptions())
        except LogOptionError as error:
            raise LogError(f"{error} (options of gapbridge convert)") from None
        show_notes(path, converted.notes)
        log = converted.log(path, cell.arm.n)
    check_log(log, cell)
    return log


def show_notes(path: Path, notes: Iterable[Note]) -> None:
    """Print what reading a log has noted."""
    for note in note_texts(notes):
        click.echo(f"note: {path}: {note}", err=True)


def at_joints_of(log: Log, simulated: Log, cell: Cell) -> Log:
    """Return a simulator's log with its TCP moved to the joint angles of ``log``, row by row.

    A simulated servo stops at other joint angles than the real one. That is a gap of the tracking
    channel, not of the position; it is removed by the difference that the cell's model predicts
    between both angles. If either log has no ``actual_q``, ``simulated`` is returned unchanged.
    """
    simulated_q, measured_q = simulated.get("actual_q"), log.get("actual_q")
    position = simulated.get("measured_position")
    if simulated_q is None or measured_q is None or position is None:
        return simulated
    real, own = cell.model.predict(measured_q), cell.model.predict(simulated_q)
    moved = {"measured_position": position + real.position - own.position}
    rotation = simulated.get("measured_rotation")
    if rotation is not None:
        turn = real.rotation @ np.swapaxes(own.rotation, 1, 2)
        moved["measured_rotation"] = rotation_vector(turn @ rotation_matrix(rotation))
    return replace(simulated, columns={**simulated.columns, **moved})


def joint_names(cell: Cell) -> tuple[str, ...]:
    """Return the names of the cell's joints: those of its URDF, or joint_1, joint_2, ..."""
    return cell.arm.joint_names or tuple(f"joint_{i + 1}" for i in range(cell.arm.n))


def check_log(log: Log, cell: Cell) -> None:
    """Raise LogError if joint angles, units or loads of a log are impossible for the arm.

    Raises CellError where the cell's own payload, of a log that declares none, is.
    """
    log.check_size()
    for name in ("actual_q", "target_q"):
        if np.isinf(log.columns.get(name, np.zeros(0))).any():
            log.require(name)  # names the cell
    check_units(cell.model, log)
    log.check_within("actual_TCP_force", np.array(WRENCH), "N or Nm")
    mass, rated = log.get("payload"), cell.arm.payload
    if mass is not None and (mass > PAYLOAD_FACTOR * rated).any():
        row = int(np.argmax(mass > PAYLOAD_FACTOR * rated))
        raise LogError(
            f"{log.path}: row {log.line(row)}, column payload: found {mass[row]:g} kg, out of "
            f"range: expected 0 to {rated:g} kg, what {cell.arm.name} is rated for"
        )
    added = cell.model.added_mass
    if mass is None:
        if (problem := cell.payload_problem) is not None:
            raise problem
    elif (below := (mass >= 0.0) & (mass + added < LoadBounds.of(cell.model).least)).any():
        row = int(np.argmax(below))
        raise LogError(
            f"{log.path}: row {log.line(row)}, column payload: found {mass[row]:g} kg and "
            f"{added:g} kg of the effects of {cell.path}, expected 0 kg or more together"
        )
