"""A model's prediction of each channel of a log, per row, measured or not."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.dynamics import predict_torque, predict_tracking, predict_wrench, with_pieces
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import EDGE, LEAD, Motion, motion_of, with_motion
from gapbridge.core.rotation import nearest_turn

NO_MASSES = "masses of the links (in the cell's robot)"
ROWS = 20_000  # predicted at a time


def predicted_channels(model: Model, log: Log) -> tuple[dict[str, Array], dict[str, str]]:
    """Return the predicted columns (N, k) by name, and for each channel without, what it needs.

    ``predicted_torque`` (Nm, joints: ``actual_current_as_torque``), ``predicted_wrench`` (N and Nm,
    flange axes: ``ft_raw_wrench``), ``predicted_q`` (rad: ``actual_q`` under the log's
    ``target_q``, on the turn of the encoders). Rows without derivatives (edges and gaps of a
    recording) are nan in torque and wrench. Raises LogError where the log holds something unusable.
    """
    motion = motion_of(log)
    predicted: dict[str, Array] = {}
    needs: dict[str, str] = {}
    with_loads = with_pieces(model, motion)
    if model.arm.mass.any():
        predicted["predicted_torque"] = _at_rows(
            predict_torque, model, with_loads, len(log), with_loads.valid
        )
    else:
        needs["torque"] = NO_MASSES
    predicted["predicted_wrench"] = _at_rows(
        predict_wrench, model, with_loads, len(log), with_loads.valid
    )
    if motion.target_q is None:
        needs["tracking"] = "target_q"
    else:
        all_rows = np.ones(len(motion), dtype=bool)
        q = _at_rows(predict_tracking, model, motion, len(log), all_rows)
        predicted["predicted_q"] = nearest_turn(q, log.require("actual_q", "target_q"))
    return predicted, needs


def with_neighbours(pieces: Iterable[Log], rows: int = ROWS) -> Iterator[tuple[Log, slice]]:
    """Yield pieces of one recording, each with the neighbouring rows that its channels depend on.

    Each is a log, and the slice of its own rows: the others are for derivatives and delays. A
    recording of at most ``rows`` is one piece.
    """
    buffer: Log | None = None
    given, start = 0, None  # rows of what is held that were given; s
    for piece in pieces:
        if start is None and piece.has("timestamp"):
            start = float(piece.columns["timestamp"][0])
        if buffer is not None and set(buffer.columns) != set(piece.columns):
            yield _with_start(buffer, start), slice(given, len(buffer))
            buffer, given = None, 0
        buffer = piece if buffer is None else _appended(buffer, piece)
        while len(buffer) - given > rows + EDGE:
            end = given + rows
            yield _with_start(buffer.select(slice(0, end + EDGE)), start), slice(given, end)
            first = max(end - _rows_before(buffer), 0)
            buffer, given = buffer.select(slice(first, None)), end - first
    if buffer is not None:
        yield _with_start(buffer, start), slice(given, len(buffer))


def _appended(log: Log, further: Log) -> Log:
    """Return a log with the rows that follow it."""
    with_loads = slice(None)
    one, other = log.select(with_loads), further.select(with_loads)  # each row with its line
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


def _with_start(log: Log, start: float | None) -> Log:
    """Return a part of a recording with the recording's start time."""
    return log if start is None else with_motion(log, replace(motion_of(log), start=start))


def _at_rows(
    predict: Callable[[Model, Motion], Array], model: Model, motion: Motion, count: int,
    valid: Mask,
) -> Array:  # fmt: skip
    """Return a prediction at the rows of the log (N, k), nan where there is none."""
    value = predict(model, motion)
    out = np.full((count, value.shape[1]), np.nan)
    out[motion.rows[valid]] = value[valid]
    return out
