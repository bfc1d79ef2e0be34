"""The commands as Python functions, with the same checks and results.

All raise InputError, with a message of one line, for unusable input.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gapbridge.bridge.api.records import Corrected, Diagnosed, Fitted, Predicted
from gapbridge.bridge.cell import Cell, load_cell
from gapbridge.bridge.cell.message import located
from gapbridge.bridge.cell.opened_log import at_joints_of, open_log
from gapbridge.bridge.document.provenance import provenance
from gapbridge.core.arrays import Array
from gapbridge.core.compensation import Correction, correct
from gapbridge.core.effects import by_approach
from gapbridge.core.errors import EquilibriumError, InputError, LogError
from gapbridge.core.fitted_range import outside_rows, range_of
from gapbridge.core.log.log import Log
from gapbridge.core.plausibility import reach
from gapbridge.core.predicted_channels import predicted_channels
from gapbridge.core.sessions import join_sessions

__all__ = ["compensate", "diagnose", "fit", "load_cell", "predict", "read_log"]

# Joint offset times reach, over what it moves and turns the TCP: 0.6 in the median of random poses
# of UR arms; above 5 wherever 0.05 rad are needed and the TCP moves by less than 0.01 m.
SINGULAR = 4.0


def read_log(path: Path | str | Sequence[Path | str], cell: Cell) -> Log:
    """Return a log for a cell's arm, checked; several paths are sessions of one arm."""
    paths = [path] if isinstance(path, (str, Path)) else list(path)
    if not paths:
        raise InputError("read_log: found no path, expected a log or several")
    return join_sessions([open_log(Path(p), cell) for p in paths], cell.model)


def predict(cell: Cell, log: Log, *, channels: bool = False) -> Predicted:
    """Return the TCP pose that the cell's model predicts for every row; ``gapbridge predict``.

    Joints are ``actual_q``; where there is none, ``target_q`` less the servos' known droop. The
    standard deviation comes from the covariance of what was fitted, where the cell has it.
    ``channels``: torque, wrench and tracking are predicted too.
    """
    _require_arm(cell, log)
    q, loads = log.require("actual_q", "target_q"), log.loads(by_approach(cell.model.terms))
    spread, ranges, std = cell.spread, cell.fitted_range, None
    try:
        if not log.has("actual_q"):
            q = cell.model.settled(q, loads)
        if spread.names:
            poses, std = spread.poses_and_std(cell.model, q, loads)
        else:
            poses = cell.model.predict(q, loads)
    except EquilibriumError as error:
        raise InputError(f"{log.path}: row {log.line(error.row)}: {error.text}") from None
    except InputError as error:
        raise located(cell.document, error) from None
    further, needs = predicted_channels(cell.model, log) if channels else ({}, {})
    return Predicted(
        poses.position, poses.rotation_vector, std,
        outside_rows(log, ranges) if ranges else None, further, needs,
        _sources(cell, log),
    )  # fmt: skip


def compensate(cell: Cell, log: Log) -> Corrected:
    """Return each row's corrected setpoint: its predicted pose is the rigid arm's at the row's q.

    Raises InputError where a row has no equilibrium, or exceeds the envelope of the cell's limits.
    """
    _require_arm(cell, log)
    loads = log.loads(by_approach(cell.model.terms))
    corrected = correct(cell.model, log.require("target_q", "actual_q"), loads)
    failed = np.flatnonzero(~np.isfinite(corrected.residual))
    if len(failed):
        raise InputError(f"{log.path}: row {log.line(failed[0])}: {EquilibriumError.text}")
    require_envelope(cell, log, corrected)
    return Corrected(corrected.q, corrected.residual, _sources(cell, log))  # type: ignore[arg-type]  # of N


def fit(cell: Cell, log: Log, *, remounted: bool = False) -> Fitted:
    """Return the joint flexibilities identified from a log; ``gapbridge fit``.

    ``remounted``: the target was taken off between sessions. Raises ExcitationError where nothing
    in the log excites the compliance.
    """
    from gapbridge.bridge.api.uncertainty import provenance_of_fit
    from gapbridge.bridge.cell.log_consistency import pose_warnings
    from gapbridge.bridge.document.notes import note_texts
    from gapbridge.core.estimation.identification import (
        identify_compliance,  # predict need not wait for it
    )

    _require_arm(cell, log)
    metrology = replace(cell.metrology, remounted=remounted)
    warnings = pose_warnings(cell, log, metrology)
    estimate = identify_compliance(cell.model, log, metrology)
    held_out = estimate.remaining_rms_held_out
    return Fitted(
        cell=cell, model=estimate.cell_model,
        axial=estimate.axial, radial=estimate.radial, std_axial=estimate.std_axial,
        std_radial=estimate.std_radial, shown=estimate.identifiable, samples=estimate.samples,
        gap_rms=estimate.gap_rms, remaining_rms=estimate.remaining_rms,
        remaining_rms_held_out=held_out if math.isfinite(held_out) else None,
        notes=(*warnings, *note_texts((*estimate.notes, *estimate.combinations))),
        provenance=provenance_of_fit(
            cell, estimate, provenance(_sources(cell, log), "fit", remounted=remounted),
            range_of(log),
        ),
    )  # fmt: skip


def diagnose(
    cell: Cell, log: Log, *, withhold: Sequence[str] = (), remounted: bool = False,
    simulated: Log | None = None, progress: Callable[[str], None] = lambda step: None,
) -> Diagnosed:  # fmt: skip
    """Return the causes of the gap between a log and the cell's model; ``gapbridge diagnose``.

    ``withhold``: effects to leave out of the catalogue. ``simulated``: log of another simulator,
    row by row, used as the prediction. ``progress`` is called with each step's name.
    """
    from gapbridge.bridge.document.diagnosis_json import document
    from gapbridge.core.diagnosis.diagnosis import channels_of
    from gapbridge.core.diagnosis.diagnosis import diagnose as diagnose_log
    from gapbridge.core.effects import effect_named
    from gapbridge.core.log.alignment import aligned
    from gapbridge.core.motion import without_turns

    _require_arm(cell, log, *([] if simulated is None else [simulated]))
    for name in withhold:
        effect_named(name)
    files = _sources(cell, log, simulated)
    if simulated is not None:
        if simulated.same_rows(log):
            raise LogError(
                f"{simulated.path}: found the rows of {log.path}, expected a simulator's log"
            )
        simulated = at_joints_of(log, aligned(without_turns(simulated), log), cell)
    metrology = replace(cell.metrology, remounted=remounted)
    try:
        diagnosis = diagnose_log(
            cell.model, log, metrology, withhold=withhold, simulated=simulated,
            progress=progress, observers=channels_of(cell.uncertain),
        )  # fmt: skip
    except LogError:
        raise  # names its log
    except InputError as error:
        raise LogError(f"{log.path}: {error}") from None
    origin = provenance(files, "diagnose", withhold=list(withhold), remounted=remounted)
    return Diagnosed(cell, log, diagnosis, document(diagnosis) | {"provenance": origin})


def _require_arm(cell: Cell, *logs: Log) -> None:
    """Raise LogError for a log that was read for an arm of another number of joints."""
    for log in logs:
        if log.n != cell.arm.n:
            raise LogError(
                f"{log.path}: found a log of {log.n} joints, expected {cell.arm.n} as the arm of "
                f"{cell.path} has"
            )


def _sources(cell: Cell, log: Log, simulated: Log | None = None) -> dict[str, list[Path]]:
    """Return the input files by role; a log made in Python has none."""
    logs, sims = (
        [path for path in map(Path, one.files or (one.path,)) if path.exists()] if one else []
        for one in (log, simulated)
    )
    return {"log": logs, "cell": [cell.path], "sim": sims}


def require_envelope(cell: Cell, log: Log, correction: Correction) -> None:
    """Raise InputError for the first row whose correction is outside the envelope.

    That is where it moves or turns the TCP by more than ``limits.offset`` (m) or
    ``limits.offset_rotation`` (rad), misses the wanted pose by more than ``limits.offset``, or
    turns a joint by more than ``limits.joint_offset`` (rad). Near a singular pose a sound cell may
    need larger joint offsets, and miss the pose by less than it corrects: that is not refused.
    """
    limits, offset = cell.limits, correction.offset_in_base
    away, turned = (np.linalg.norm(part, axis=1) for part in (offset[:, :3], offset[:, 3:]))
    missed = np.atleast_1d(correction.residual)
    joint = joint_offsets(log, correction.q)
    outside = (away > limits.offset) | (turned > limits.offset_rotation) | (missed > limits.offset)
    wide = joint > limits.joint_offset
    if wide.any():
        length = reach(cell.arm)
        outside |= wide & (joint * length <= SINGULAR * (away + length * turned))
    if not outside.any():
        return
    row, most = int(outside.argmax()), limits.offset
    if missed[row] > limits.offset:
        value = above(missed[row], most, 1e3)
        found = f"the corrected setpoint misses the wanted pose by {value} mm"
        limit = f"{1e3 * most:g} mm (limits.offset"
    elif away[row] > limits.offset:
        found = f"the correction moves the TCP by {above(away[row], most, 1e3)} mm"
        limit = f"{1e3 * most:g} mm (limits.offset"
    elif turned[row] > limits.offset_rotation:
        most = limits.offset_rotation
        found = f"the correction turns the TCP by {above(turned[row], most)} rad"
        limit = f"{limits.offset_rotation:g} rad (limits.offset_rotation"
    else:
        found = f"the correction turns a joint by {above(joint[row], limits.joint_offset)} rad"
        limit = f"{limits.joint_offset:g} rad (limits.joint_offset"
    raise InputError(
        f"{log.path}: row {log.line(row)}: {found}, expected at most {limit} of {cell.path})"
    )


def joint_offsets(log: Log, corrected_q: Array) -> Array:
    """Return the largest joint offset (N,) of each row, rad, for corrected setpoints (N, n)."""
    largest: Array = np.abs(corrected_q - log.require("target_q", "actual_q")).max(axis=1)
    return largest


def above(value: float, limit: float, factor: float = 1.0) -> str:
    """Return ``factor`` times a value above a limit, in enough digits to show that it is above."""
    for digits in range(3, 17):
        text = f"{factor * value:.{digits}g}"
        if float(text) > factor * limit:
            return text
    return str(factor * value)
