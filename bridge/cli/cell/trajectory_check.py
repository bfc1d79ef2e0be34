"""A cell's trajectory beside the limits that a run keeps."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.message import message_at
from gapbridge.bridge.cell.plausibility import Findings
from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.bridge.loop.setpoint_stream import limits_of
from gapbridge.core.log.log import read_log
from gapbridge.core.plausibility import MAX_LIMIT

FILE = ("setpoints", "file")
ROUNDING = 1e-6  # of the velocity limit
JUMP = 2.0  # times the velocity limit: faster setpoints are refused, slower ones followed late


def trajectory_findings(cell: Cell, setpoints: SetpointSettings, rate: float) -> Findings:
    """Return the first row outside the joint limits, and the fastest one above the velocity limits.

    ``setpoints`` names a trajectory that a run can read, by its absolute path; ``rate``: Hz.
    """
    path = cell.path.parent / (setpoints.file or "")
    limits = limits_of(cell.limits, cell.arm, rate)
    log = read_log(path, cell.arm.n)
    q = log.require("target_q")
    outside = np.argwhere((q < limits.lower) | (q > limits.upper))
    if len(outside):
        row, joint = map(int, outside[0])
        units = " (it looks like degrees)" if abs(q[row, joint]) > MAX_LIMIT else ""
        text = (
            f"{path}: row {log.line(row)}, column target_q_{joint}: found {q[row, joint]:.4f} rad, "
            f"expected {limits.lower[joint]:.4f} to {limits.upper[joint]:.4f}{units}"
        )
        return Findings([message_at(cell.document, FILE, text)], [])
    time = log.require("timestamp")
    # of all windows of one cycle, the largest step begins or ends at a row
    begins = np.concatenate([time, time - 1.0 / rate])
    ends = np.concatenate([time + 1.0 / rate, time])
    steps = [np.interp(ends, time, column) - np.interp(begins, time, column) for column in q.T]
    share = np.abs(steps).T * rate / limits.velocity
    if (worst := float(share.max())) <= 1.0 + ROUNDING:
        return Findings([], [])
    window, joint = (int(i) for i in np.unravel_index(int(share.argmax()), share.shape))
    row = log.line(min(int(np.searchsorted(time, ends[window])), len(time) - 1))
    limit = limits.velocity[joint]
    text = message_at(
        cell.document, FILE,
        f"{path}: row {row}, column target_q_{joint}: found {worst * limit:.3g} rad/s, expected at "
        f"most {limit:.3g}: `run` {'refuses such a jump' if worst > JUMP else 'lags behind it'}",
    )  # fmt: skip
    return Findings([text], []) if worst > JUMP else Findings([], [text])
