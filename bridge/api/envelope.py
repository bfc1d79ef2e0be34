"""The envelope that a cell's ``limits`` state, for corrections of the rows of a log."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.cell import Cell
from gapbridge.core.arrays import Array
from gapbridge.core.compensation import Correction
from gapbridge.core.errors import InputError
from gapbridge.core.log.log import Log
from gapbridge.core.plausibility import reach

# Joint offset times reach, over what it moves and turns the TCP: 0.6 in the median of random poses
# of UR arms; above 5 wherever 0.05 rad are needed and the TCP moves by less than 0.01 m.
SINGULAR = 4.0


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
