"""What was measured while the arm stood still: the recording and the tracker, joined by time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gapbridge.bridge.demo.poses import Load
from gapbridge.bridge.document.output_file import write_table
from gapbridge.core.arrays import Array
from gapbridge.core.errors import RunError
from gapbridge.core.rotation import mean_rotation

STILL = 0.003  # rad/s: slower than this, the arm stands
SETTLING = 0.15  # s from standing still until readings count
LEAVING = 0.04  # s before it moves on from which they no longer count
FEWEST = 8  # readings of the tracker at one rest
FEW_READINGS = "readings of the tracker"
NEAR = 0.05  # rad between a visited pose and the one that was meant


@dataclass(frozen=True)
class Rests:
    """M rests of the arm, one row each, in the order of the visits."""

    timestamp: Array  # (M,) s, controller clock
    nominal_q: Array  # (M, n) rad, the pose that was meant
    actual_q: Array  # (M, n) rad
    payload: Array  # (M,) kg, declared in the controller
    payload_cog: Array  # (M, 3) m
    force: Array  # (M, 6) N, Nm: actual_TCP_force
    position: Array  # (M, 3) m, measured
    rotation: Array  # (M, 3) rad, measured, rotation vector

    def __len__(self) -> int:
        return len(self.timestamp)


def rests_so_far(
    recording: Mapping[str, Array],
    readings: Array,
    visited: Array,
    load: Load | None = None,
    settling: float = SETTLING,
) -> tuple[Rests | None, str]:
    """Return the rests at the ``visited`` poses (M, n), in their order, and why one is missing.

    Up to the first that is missing; None: all are. ``recording`` holds columns by RTDE name,
    ``readings`` (K, 7) is the tracker's; ``load`` is what the arm carried, where the controller
    does not report it.
    """
    if "timestamp" not in recording:
        return None, "the recording holds no state of the arm, expected one of each cycle"
    if load is not None and "payload" not in recording:
        recording = {**recording, **_declared(load, len(recording["timestamp"]))}
    spans = _spans(recording, settling)
    rows: list[tuple[Array, ...]] = []
    missing = ""
    for number, pose in enumerate(visited):
        span = _next_span(recording, spans, pose)
        if span is None:
            missing = f"visit {number + 1} of {len(visited)}: the arm never rested there"
            break
        try:
            rows.append(_rest(recording, readings, span, pose, number, settling))
        except RunError as error:
            missing = str(error)
            break
    if not rows:
        return None, missing
    return Rests(*(np.array(column) for column in zip(*rows, strict=True))), missing


def _declared(load: Load, count: int) -> dict[str, Array]:
    """Return the columns of a load that stayed the same for ``count`` rows."""
    return {
        "payload": np.full(count, load.mass),
        "payload_cog": np.tile(load.cog, (count, 1)),
        "actual_TCP_force": np.tile(load.wrench, (count, 1)),
    }


def _spans(recording: Mapping[str, Array], settling: float) -> list[slice]:
    """Return the stretches in which the arm stood still for longer than it takes to settle."""
    t = recording["timestamp"]
    still = np.abs(recording["actual_qd"]).max(axis=1) < STILL
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    pairs = zip(edges[::2], edges[1::2] - 1, strict=True)
    return [slice(a, b + 1) for a, b in pairs if t[b] - t[a] > settling + LEAVING]


def _next_span(recording: Mapping[str, Array], spans: list[slice], pose: Array) -> slice | None:
    """Take the first span at a pose out of the list, with those before it."""
    while spans:
        span = spans.pop(0)
        if np.abs(recording["actual_q"][span.stop - 1] - pose).max() < NEAR:
            return span
    return None


def _rest(
    recording: Mapping[str, Array], readings: Array, span: slice, pose: Array, number: int,
    settling: float,
) -> tuple[Array, ...]:  # fmt: skip
    t = recording["timestamp"][span]
    begin, end = t[0] + settling, t[-1] - LEAVING
    seen = readings[(readings[:, 0] >= begin) & (readings[:, 0] <= end)]
    if len(seen) < FEWEST:
        raise RunError(f"visit {number + 1}: found {len(seen)} {FEW_READINGS}, expected {FEWEST}")
    during = np.arange(span.start, span.stop)[(t >= begin) & (t <= end)]
    return (
        np.array(begin),
        pose,
        # the middle one: the servo's tail, some nanoradians, is no place to rest at
        np.median(recording["actual_q"][during], axis=0),
        recording["payload"][during].mean(),
        recording["payload_cog"][during].mean(axis=0),
        recording["actual_TCP_force"][during].mean(axis=0),
        seen[:, 1:4].mean(axis=0),
        mean_rotation(seen[:, 4:7]),
    )


def joined(parts: list[Rests]) -> Rests:
    """Return several runs' rests as one."""
    fields = Rests.__dataclass_fields__
    return Rests(*(np.concatenate([getattr(part, name) for part in parts]) for name in fields))


def write_log(path: Path, rests: Rests, joints: bool = True) -> None:
    """Write rests as a log in a log's columns, with or without the joints as read."""
    columns = {
        "timestamp": rests.timestamp,
        "target_q": rests.nominal_q,
        "actual_q": rests.actual_q,
        "payload": rests.payload,
        "payload_cog": rests.payload_cog,
        "actual_TCP_force": rests.force,
        "measured_position": rests.position,
        "measured_rotation": rests.rotation,
    }
    if not joints:
        del columns["actual_q"]
    names: list[str] = []
    for name, values in columns.items():
        names += [name] if values.ndim == 1 else [f"{name}_{i}" for i in range(values.shape[1])]
    write_table(path, names, np.hstack([v.reshape(len(v), -1) for v in columns.values()]))
