"""What was fitted and what was not: ranges of joints, loads and temperatures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.sessions import sessions_in

Range = Mapping[str, tuple[float, float]]
MARGIN = 0.05  # of a range's width: so far beyond it nothing is said
MANY = 0.25  # share of a session's rows beyond the others' from which it is worth a sentence
LEAST = {"actual_q": 0.05, "payload": 0.1, "joint_temperatures": 2.0, "actual_TCP_force": 5.0}
UNITS = {"actual_q": "rad", "payload": "kg", "joint_temperatures": "°C", "actual_TCP_force": "N"}


def range_of(log: Log) -> dict[str, tuple[float, float]]:
    """Return the least and largest value of each joint, load and temperature column of a log."""
    found = {}
    for name, values in _columns(log).items():
        kept = values[np.isfinite(values)]
        if len(kept):
            found[name] = (float(kept.min()), float(kept.max()))
    return found


def merged(ranges: Iterable[Range]) -> dict[str, tuple[float, float]]:
    """Return the ranges that hold all of the given ones."""
    whole: dict[str, tuple[float, float]] = {}
    for one in ranges:
        for name, (low, high) in one.items():
            known = whole.get(name, (low, high))
            whole[name] = (min(known[0], low), max(known[1], high))
    return whole


class Outside:
    """How far a log, given in pieces, lies outside what was fitted."""

    def __init__(self, fitted: Range) -> None:
        self._fitted = fitted
        self._rows = 0
        self._count: dict[str, int] = {}
        self._worst: dict[str, tuple[float, int, float]] = {}  # from the middle, line, value

    def add(self, log: Log) -> None:
        """Look at one more piece."""
        self._rows += len(log)
        for name, values in _columns(log).items():
            if name not in self._fitted:
                continue
            rows = np.flatnonzero(beyond(name, values, self._fitted))
            if not len(rows):
                continue
            away = np.abs(values[rows] - sum(self._fitted[name]) / 2)
            worst = int(np.argmax(away))
            found = float(away[worst]), log.line(rows[worst]), float(values[rows[worst]])
            self._count[name] = self._count.get(name, 0) + len(rows)
            self._worst[name] = max(self._worst.get(name, found), found, key=lambda one: one[0])

    def findings(self) -> list[LogFinding]:
        """Return one finding for each quantity that lies outside."""
        found = []
        for name, count in self._count.items():
            (low, high), (_, line, value) = self._fitted[name], self._worst[name]
            values = (name,), count, self._rows, low, high, UNITS[stem_of(name)], line, value
            found.append(LogFinding(LogCheck.BEYOND_FITTED, values))
        return found


def outside_rows(log: Log, fitted: Range) -> Mask:
    """Return which rows (N,) lie outside what was fitted, in any quantity."""
    out = np.zeros(len(log), dtype=bool)
    for name, values in _columns(log).items():
        if name in fitted:
            out |= beyond(name, values, fitted)
    return out


def beyond(name: str, values: Array, fitted: Range) -> Mask:
    """Return which values (N,) of a column lie outside what was fitted; NaN does not."""
    low, high = fitted[name]
    margin = max(MARGIN * (high - low), LEAST[stem_of(name)])
    return np.asarray((values < low - margin) | (values > high + margin))


def outside_findings(log: Log) -> list[LogFinding]:
    """Return where many of a session's rows lie outside what the other sessions hold."""
    parts = sessions_in(log)
    ranges, found = [range_of(part) for part in parts], []
    for s, (name, part) in enumerate(zip(log.session_names, parts, strict=True)):
        others = merged(one for i, one in enumerate(ranges) if i != s)
        columns = tuple(c for c, share in _beyond(part, others).items() if share >= MANY)
        if columns:
            found.append(LogFinding(LogCheck.BEYOND_SESSIONS, (name, columns)))
    return found


def _beyond(log: Log, fitted: Range) -> dict[str, float]:
    """Return the share of rows that lie outside, per column."""
    found = {}
    for name, values in _columns(log).items():
        if name in fitted:
            found[name] = float(np.mean(beyond(name, values, fitted)))
    return found


def stem_of(name: str) -> str:
    """Return a column's name without its index."""
    return name if name in UNITS else name.rpartition("_")[0]


def _columns(log: Log) -> dict[str, Array]:
    joints = log.get("actual_q")
    given = {
        "actual_q": log.get("target_q") if joints is None else joints,
        "payload": log.get("payload"),
        "joint_temperatures": log.get("joint_temperatures"),
        "actual_TCP_force": log.get("actual_TCP_force"),
    }
    found: dict[str, Array] = {}
    for name, column in given.items():
        if column is None:
            continue
        if column.ndim == 1:
            found[name] = column
        else:
            found |= {f"{name}_{i}": column[:, i] for i in range(column.shape[1])}
    return found
