"""Ranges of joints, loads and temperatures of the fitted data, and checks against them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.log.columns import scalars
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.sessions import sessions_in

Range = Mapping[str, tuple[float, float]]
MARGIN = 0.05  # of a range's width, beyond it, that counts as inside
MIN_SHARE = 0.25  # share of a session's rows outside the others' range that is reported
MIN_MARGIN = {"actual_q": 0.05, "payload": 0.1, "joint_temperatures": 2.0, "actual_TCP_force": 5.0}
UNITS = {"actual_q": "rad", "payload": "kg", "joint_temperatures": "°C", "actual_TCP_force": "N"}


def range_of(log: Log) -> dict[str, tuple[float, float]]:
    """Return the least and largest value of each joint, load and temperature column of a log."""
    result = {}
    for name, values in _columns(log).items():
        kept = values[np.isfinite(values)]
        if len(kept):
            result[name] = (float(kept.min()), float(kept.max()))
    return result


def merged(ranges: Iterable[Range]) -> dict[str, tuple[float, float]]:
    """Return the ranges that hold all of the given ones."""
    merged_ranges: dict[str, tuple[float, float]] = {}
    for one in ranges:
        for name, (low, high) in one.items():
            previous = merged_ranges.get(name, (low, high))
            merged_ranges[name] = (min(previous[0], low), max(previous[1], high))
    return merged_ranges


class Outside:
    """How far a log, given in pieces, is outside the fitted ranges."""

    def __init__(self, fitted: Range) -> None:
        self._fitted = fitted
        self._rows = 0
        self._count: dict[str, int] = {}
        self._worst: dict[str, tuple[float, int, float]] = {}  # from the middle, line, value

    def add(self, log: Log) -> None:
        """Check one more piece."""
        self._rows += len(log)
        for name, values in _columns(log).items():
            if name not in self._fitted:
                continue
            rows = np.flatnonzero(beyond(name, values, self._fitted))
            if not len(rows):
                continue
            distance = np.abs(values[rows] - sum(self._fitted[name]) / 2)
            worst = int(np.argmax(distance))
            result = float(distance[worst]), log.line(rows[worst]), float(values[rows[worst]])
            self._count[name] = self._count.get(name, 0) + len(rows)
            self._worst[name] = max(self._worst.get(name, result), result, key=lambda one: one[0])

    def findings(self) -> list[LogFinding]:
        """Return one finding for each quantity outside its range."""
        result = []
        for name, count in self._count.items():
            (low, high), (_, line, value) = self._fitted[name], self._worst[name]
            values = (name,), count, self._rows, low, high, UNITS[stem_of(name)], line, value
            result.append(LogFinding(LogCheck.BEYOND_FITTED, values))
        return result


def outside_rows(log: Log, fitted: Range) -> Mask:
    """Return which rows (N,) are outside the fitted ranges, in any quantity."""
    out = np.zeros(len(log), dtype=bool)
    for name, values in _columns(log).items():
        if name in fitted:
            out |= beyond(name, values, fitted)
    return out


def beyond(name: str, values: Array, fitted: Range) -> Mask:
    """Return which values (N,) of a column are outside the fitted range; NaN is not."""
    low, high = fitted[name]
    margin = max(MARGIN * (high - low), MIN_MARGIN[stem_of(name)])
    return np.asarray((values < low - margin) | (values > high + margin))


def outside_findings(log: Log) -> list[LogFinding]:
    """Return the sessions with many rows outside the ranges of the other sessions."""
    parts = sessions_in(log)
    ranges, result = [range_of(part) for part in parts], []
    for s, (name, part) in enumerate(zip(log.session_names, parts, strict=True)):
        others = merged(one for i, one in enumerate(ranges) if i != s)
        columns = tuple(c for c, share in _beyond(part, others).items() if share >= MIN_SHARE)
        if columns:
            result.append(LogFinding(LogCheck.BEYOND_SESSIONS, (name, columns)))
    return result


def _beyond(log: Log, fitted: Range) -> dict[str, float]:
    """Return the share of rows outside the fitted range, per column."""
    result = {}
    for name, values in _columns(log).items():
        if name in fitted:
            result[name] = float(np.mean(beyond(name, values, fitted)))
    return result


def stem_of(name: str) -> str:
    """Return a column's name without its index."""
    return name if name in UNITS else name.rpartition("_")[0]


def _columns(log: Log) -> dict[str, Array]:
    columns = {
        "actual_q": log.get("actual_q", "target_q"),
        "payload": log.get("payload"),
        "joint_temperatures": log.get("joint_temperatures"),
        "actual_TCP_force": log.get("actual_TCP_force"),
    }
    return scalars(columns)
