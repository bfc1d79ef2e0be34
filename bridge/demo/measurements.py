"""Static pose measurements: recording and tracker readings while the arm is at rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gapbridge.bridge.demo.poses import Load
from gapbridge.bridge.document.output_file import write_table
from gapbridge.core.arrays import Array
from gapbridge.core.errors import RunError
from gapbridge.core.log.columns import as_table
from gapbridge.core.rotation import mean_rotation

MAX_STILL_SPEED = 0.003  # rad/s, fastest joint of an arm at rest
SETTLING_TIME = 0.15  # s at rest before readings count
DEPARTURE_TIME = 0.04  # s before the next move in which they no longer count
MIN_READINGS = 8  # of the tracker, per pose
MAX_POSE_ERROR = 0.05  # rad between the visited pose and the commanded one


class TooFewReadingsError(RunError):
    """At a pose the tracker measured less often than a mean needs, or no cycle was recorded."""


@dataclass(frozen=True)
class Measurements:
    """M static measurements, one row each, in the order of the visits."""

    timestamp: Array  # (M,) s, controller clock
    nominal_q: Array  # (M, n) rad, intended pose
    actual_q: Array  # (M, n) rad
    payload: Array  # (M,) kg, declared in the controller
    payload_cog: Array  # (M, 3) m
    force: Array  # (M, 6) N, Nm: actual_TCP_force
    position: Array  # (M, 3) m, measured
    rotation: Array  # (M, 3) rad, measured, rotation vector

    def __len__(self) -> int:
        return len(self.timestamp)


def measurements_at(
    recording: Mapping[str, Array],
    readings: Array,
    poses: Array,
    load: Load | None = None,
    settling: float = SETTLING_TIME,
) -> tuple[Measurements | None, RunError | None]:
    """Return the measurements at the ``poses`` (M, n), up to the first missing one, and its error.

    None where all are missing. ``recording`` holds columns by RTDE name, ``readings`` (K, 7) are
    the tracker's (time, position, rotation vector); ``load`` is the load of the arm where the
    controller does not report it; ``settling``: s at rest before readings count.
    """
    if "timestamp" not in recording:
        return None, RunError("the recording holds no state of the arm, expected one per cycle")
    if load is not None and "payload" not in recording:
        recording = {**recording, **_load_columns(load, len(recording["timestamp"]))}
    spans = _static_spans(recording, settling)
    rows: list[tuple[Array, ...]] = []
    missing: RunError | None = None
    for number, pose in enumerate(poses):
        span = _next_span(recording, spans, pose)
        if span is None:
            text = f"visit {number + 1} of {len(poses)}: the arm was never at rest there"
            missing = RunError(text)
            break
        try:
            rows.append(_measurement(recording, readings, span, pose, number, settling))
        except TooFewReadingsError as error:
            missing = error
            break
    if not rows:
        return None, missing
    return Measurements(*(np.array(column) for column in zip(*rows, strict=True))), missing


def _load_columns(load: Load, count: int) -> dict[str, Array]:
    """Return the columns of a constant load for ``count`` rows."""
    return {
        "payload": np.full(count, load.mass),
        "payload_cog": np.tile(load.cog, (count, 1)),
        "actual_TCP_force": np.tile(load.wrench, (count, 1)),
    }


def _static_spans(recording: Mapping[str, Array], settling: float) -> list[slice]:
    """Return the spans in which the arm was at rest for longer than the settling time."""
    t = recording["timestamp"]
    still = np.abs(recording["actual_qd"]).max(axis=1) < MAX_STILL_SPEED
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    pairs = zip(edges[::2], edges[1::2] - 1, strict=True)
    return [slice(a, b + 1) for a, b in pairs if t[b] - t[a] > settling + DEPARTURE_TIME]


def _next_span(recording: Mapping[str, Array], spans: list[slice], pose: Array) -> slice | None:
    """Return the first span at a pose; removes it and those before it from ``spans``."""
    while spans:
        span = spans.pop(0)
        if np.abs(recording["actual_q"][span.stop - 1] - pose).max() < MAX_POSE_ERROR:
            return span
    return None


def _measurement(
    recording: Mapping[str, Array], readings: Array, span: slice, pose: Array, number: int,
    settling: float,
) -> tuple[Array, ...]:  # fmt: skip
    t = recording["timestamp"][span]
    begin, end = t[0] + settling, t[-1] - DEPARTURE_TIME
    used = readings[(readings[:, 0] >= begin) & (readings[:, 0] <= end)]
    if len(used) < MIN_READINGS:
        found = f"visit {number + 1}: found {len(used)} readings of the tracker"
        raise TooFewReadingsError(f"{found}, expected {MIN_READINGS}")
    during = np.arange(span.start, span.stop)[(t >= begin) & (t <= end)]
    if not len(during):  # this machine stalled for as long as the arm rested
        found = f"visit {number + 1}: found no recorded cycle between {begin:.3f} and {end:.3f} s"
        raise TooFewReadingsError(f"{found} of rest, expected some")
    return (
        np.array(begin),
        pose,
        # median: the servo's settling tail of some nanoradians must not enter
        np.median(recording["actual_q"][during], axis=0),
        recording["payload"][during].mean(),
        recording["payload_cog"][during].mean(axis=0),
        recording["actual_TCP_force"][during].mean(axis=0),
        used[:, 1:4].mean(axis=0),
        mean_rotation(used[:, 4:7]),
    )


def joined(parts: list[Measurements]) -> Measurements:
    """Return the measurements of several runs as one."""
    fields = Measurements.__dataclass_fields__
    columns = (np.concatenate([getattr(part, name) for part in parts]) for name in fields)
    return Measurements(*columns)


def write_log(path: Path, measurements: Measurements, joints: bool = True) -> None:
    """Write a log (CSV), with or without the measured joints ``actual_q``."""
    columns = {
        "timestamp": measurements.timestamp,
        "target_q": measurements.nominal_q,
        "actual_q": measurements.actual_q,
        "payload": measurements.payload,
        "payload_cog": measurements.payload_cog,
        "actual_TCP_force": measurements.force,
        "measured_position": measurements.position,
        "measured_rotation": measurements.rotation,
    }
    if not joints:
        del columns["actual_q"]
    write_table(path, *as_table(columns))
