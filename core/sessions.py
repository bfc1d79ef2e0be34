"""Several logs of one arm: each a session with its own frame, all with the same effects.

Joined, they are one log with a column ``session``, the index (from 0) of each row's session.
Sessions share one clock; where their clocks overlap (each started at zero), later sessions are
shifted after the earlier ones, and ``one_clock`` is False.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.errors import LogError
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import is_moving

GAP = 60.0  # s between sessions whose clocks overlap
MIN_ROWS = 20  # of a session, to detect whether it records motion
MEASURED = ("measured_position", "measured_rotation", "ft_raw_wrench", "actual_current_as_torque")


def session_of(log: Log) -> Index:
    """Return the index (N,) of each row's session; zeros where the log is one session."""
    if len(log.session_names) < 2:
        return np.zeros(len(log), dtype=np.int64)
    return np.asarray(log.columns["session"], dtype=np.int64)


def sessions_in(log: Log) -> list[Log]:
    """Return the log of each session of a joined log; rows keep their lines."""
    if len(log.session_names) < 2:
        return [log]
    index = session_of(log)
    return [
        replace(log.select(rows), session_names=())
        for rows in (np.flatnonzero(index == s) for s in range(len(log.session_names)))
    ]


def with_sessions(log: Log, model: Model) -> Log:
    """Return a log with a column ``session`` as joined sessions; any other log as it is.

    Raises LogError where the column holds no whole number, or a session's rows lie apart.
    """
    if not log.has("session") or log.session_names:
        return log
    number = log.require("session")
    not_whole = np.flatnonzero(number != np.round(number))
    if len(not_whole):
        row = int(not_whole[0])
        raise LogError(
            f"{log.path}: row {log.line(row)}, column session: found {number[row]:g}, expected a "
            "whole number"
        )
    starts = np.concatenate([[0], np.flatnonzero(np.diff(number)) + 1])
    order = number[starts]
    for k, value in enumerate(order):
        if value in order[:k]:
            raise LogError(
                f"{log.path}: row {log.line(starts[k])}, column session: found {value:g} again "
                f"after {order[k - 1]:g}, expected the rows of a session side by side"
            )
    if len(order) == 1:
        return log
    ends = [*starts[1:], len(number)]
    parts = [log.select(slice(a, b)) for a, b in zip(starts, ends, strict=True)]
    return _join(parts, tuple(f"{value:g}" for value in order), model, log.path)


def join_sessions(logs: Sequence[Log], model: Model) -> Log:
    """Return several logs as one log of as many sessions, named by their files.

    Columns of loads that a session lacks take the model's own values; a channel that a session
    lacks is empty in it; other columns have to be in all. Raises LogError where one of the logs
    is itself several sessions or a copy of another, or poses at rest stand beside recordings of
    motion.
    """
    if len(logs) == 1:
        return with_sessions(logs[0], model)
    names = _names([log.path for log in logs])
    for first, log in itertools.combinations(logs, 2):
        if log.same_rows(first):
            raise LogError(f"{log.path}: found the rows of {first.path}, expected each log once")
    for log in logs:
        if log.has("session") and np.ptp(log.require("session")) > 0:
            raise LogError(
                f"{log.path}: column session: found several sessions beside further logs, "
                "expected one log a session, or one log with all of them"
            )
    paths = [log.path for log in logs]
    joined = _join(logs, names, model, ", ".join(paths))
    # rows without times are numbered from 1 in each file: clocks that overlap
    one_clock = joined.one_clock and joined.has("timestamp")
    return replace(joined, files=tuple(paths), one_clock=one_clock)


def _names(paths: Sequence[str]) -> tuple[str, ...]:
    """Return the files' names, with as many folders as distinguish them."""
    parts = [Path(path).parts for path in paths]
    for count in range(1, max(len(p) for p in parts) + 1):
        names = ["/".join(p[-count:]) for p in parts]
        if len(set(names)) == len(names):
            return tuple(names)
    raise LogError(f"{paths[0]}: found twice, expected each log once")


def _join(logs: Sequence[Log], names: tuple[str, ...], model: Model, path: str) -> Log:
    _check_kinds(logs)
    logs = [_with_approach(log) for log in logs]
    names_of_each = [set(log.columns) for log in logs]
    everywhere, somewhere = set.intersection(*names_of_each), set.union(*names_of_each)
    columns: dict[str, Array] = {}
    for name in sorted(somewhere - {"session", "timestamp"}):
        parts = [_column(log, name, model) for log in logs]
        if all(part is not None for part in parts):
            columns[name] = np.concatenate([part for part in parts if part is not None])
    count = [len(log) for log in logs]
    columns["session"] = np.repeat(np.arange(len(logs), dtype=float), count)
    one_clock = True
    if "timestamp" in everywhere:
        columns["timestamp"], one_clock = _clock([log.columns["timestamp"] for log in logs])
    lines = np.concatenate([[log.line(r) for r in range(len(log))] for log in logs])
    return Log(
        path, columns, logs[0].n, lines=lines, numbers=np.arange(len(lines)) + 1,
        session_names=names, one_clock=one_clock,
        unknown=tuple(dict.fromkeys(u for log in logs for u in log.unknown)),
    )  # fmt: skip


def _check_kinds(logs: Sequence[Log]) -> None:
    """Raise LogError where recordings of motion and poses at rest are mixed."""
    kinds: dict[bool, str] = {}
    for log in logs:
        q = log.get("actual_q", "target_q")
        time = log.get("timestamp")
        if q is None or time is None or len(log) < MIN_ROWS:
            continue
        log.require("timestamp")
        kinds.setdefault(is_moving(time, q, log.get("actual_qd")), log.path)
    if len(kinds) > 1:
        raise LogError(
            f"{kinds[False]}: found poses at rest beside the motion recorded in {kinds[True]}, "
            "expected sessions of one kind"
        )


def _with_approach(log: Log) -> Log:
    """Return the log with its directions of approach, before sessions are joined."""
    approach = log.approach()
    return log if approach is None else replace(log, columns={**log.columns, "approach": approach})


def _column(log: Log, name: str, model: Model) -> Array | None:
    """Return a session's column, or its default; None: the joined log lacks it."""
    if name in log.columns:
        return log.columns[name]
    defaults: dict[str, Array] = {
        "payload": np.array(model.payload_mass),
        "payload_cog": model.payload_cog,
        "joint_temperatures": np.full(log.n, model.reference_temperature),
        "actual_TCP_force": np.zeros(6),
    }
    if name in defaults:
        return np.tile(defaults[name], (len(log), *(1 for _ in defaults[name].shape)))
    if name in MEASURED and name != "measured_rotation":
        width = {"measured_position": 3, "ft_raw_wrench": 6}.get(name, log.n)
        return np.full((len(log), width), np.nan)
    return None


def _clock(times: Sequence[Array]) -> tuple[Array, bool]:
    """Return the joined timestamps (N,), and whether they are the sessions' own."""
    pairs = itertools.pairwise(times)
    if all(later[0] > earlier[-1] for earlier, later in pairs):
        return np.concatenate(times), True
    shifted, end = [times[0]], float(times[0][-1])
    for time in times[1:]:
        shifted.append(time - time[0] + end + GAP)
        end = float(shifted[-1][-1])
    return np.concatenate(shifted), False
