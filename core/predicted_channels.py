"""What a model predicts of each channel of a log, row by row, whether it was measured or not."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.dynamics import predict_torque, predict_tracking, predict_wrench, with_pieces
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import EDGE, LEAD, Motion, motion_of, with_motion

NO_MASSES = "masses of the links (in the cell's robot)"
ROWS = 20_000  # predicted at a time


def predicted_channels(model: Model, log: Log) -> tuple[dict[str, Array], dict[str, str]]:
    """Return the predicted columns (N, k) by name, and for each channel without, what it needs.

    ``predicted_torque`` (Nm, joints: ``actual_current_as_torque``), ``predicted_wrench`` (N and Nm,
    flange axes: ``ft_raw_wrench``), ``predicted_q`` (rad: ``actual_q`` under the log's
    ``target_q``). Rows without derivatives (edges and gaps of a recording) are nan in torque and
    wrench. Raises LogError where the log holds something unusable.
    """
    motion = motion_of(log)
    found: dict[str, Array] = {}
    needs: dict[str, str] = {}
    whole = with_pieces(model, motion)
    if model.arm.mass.any():
        found["predicted_torque"] = _spread(predict_torque, model, whole, len(log), whole.valid)
    else:
        needs["torque"] = NO_MASSES
    found["predicted_wrench"] = _spread(predict_wrench, model, whole, len(log), whole.valid)
    if motion.target_q is None:
        needs["tracking"] = "target_q"
    else:
        every = np.ones(len(motion), dtype=bool)
        found["predicted_q"] = _spread(predict_tracking, model, motion, len(log), every)
    return found, needs


def in_context(pieces: Iterable[Log], rows: int = ROWS) -> Iterator[tuple[Log, slice]]:
    """Yield the pieces of one recording with the rows around that their channels depend on.

    Each comes as a log, and which rows of it are its own: those before and after are there for
    derivatives, and for delays that look back. What is not longer than ``rows`` comes as a whole.
    """
    held: Log | None = None
    done, start = 0, None  # rows of what is held that were given; s
    for piece in pieces:
        if start is None and piece.has("timestamp"):
            start = float(piece.columns["timestamp"][0])
        if held is not None and set(held.columns) != set(piece.columns):
            yield _from(held, start), slice(done, len(held))
            held, done = None, 0
        held = piece if held is None else _joined(held, piece)
        while len(held) - done > rows + EDGE:
            end = done + rows
            yield _from(held.select(slice(0, end + EDGE)), start), slice(done, end)
            first = max(end - _rows_before(held), 0)
            held, done = held.select(slice(first, None)), end - first
    if held is not None:
        yield _from(held, start), slice(done, len(held))


def _joined(log: Log, further: Log) -> Log:
    """Return a log with the rows that follow it."""
    whole = slice(None)
    one, other = log.select(whole), further.select(whole)  # each row with its line
    assert one.lines is not None
    assert other.lines is not None
    return replace(
        one, lines=np.concatenate([one.lines, other.lines]),
        columns={n: np.concatenate([v, other.columns[n]]) for n, v in one.columns.items()},
        numbers=None if one.numbers is None or other.numbers is None
        else np.concatenate([one.numbers, other.numbers]),
    )  # fmt: skip


def _rows_before(log: Log) -> int:
    time = log.get("timestamp")
    step = 0.0 if time is None else float(np.median(np.diff(time)))
    return EDGE + (int(np.ceil(LEAD / step)) if step > 0 else 0)


def _from(log: Log, start: float | None) -> Log:
    """Return a part of a recording that knows when the recording begins."""
    return log if start is None else with_motion(log, replace(motion_of(log), start=start))


def _spread(
    predict: Callable[[Model, Motion], Array], model: Model, motion: Motion, count: int,
    valid: Mask,
) -> Array:  # fmt: skip
    """Return a prediction at the rows of the log (N, k), nan where there is none."""
    value = predict(model, motion)
    out = np.full((count, value.shape[1]), np.nan)
    out[motion.rows[valid]] = value[valid]
    return out
