"""The controller's own kinematics: the nominal rigid arm, forward and inverse.

This is what a UR controller computes with; it knows nothing of what the plant hides.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gapbridge.drivers.simulated.plant.plant_arm import Frame, PlantArm, place
from gapbridge.drivers.simulated.plant.plant_settings import Vector6
from gapbridge.drivers.simulated.plant.rotations import (
    Vector3,
    add,
    compose,
    cross,
    from_vector,
    rotate,
    scale,
    subtract,
    to_vector,
    transpose,
)

Joints = tuple[float, ...]


def frame_of(pose: Sequence[float]) -> Frame:
    """Return the frame of a UR pose: x, y, z (m) and rotation vector (rad)."""
    x, y, z, rx, ry, rz = pose
    return Frame(from_vector((rx, ry, rz)), (x, y, z))


def pose_of(frame: Frame) -> Vector6:
    """Return the UR pose of a frame."""
    return (*frame.origin, *to_vector(frame.rotation))


def gap(here: Frame, there: Frame) -> Vector6:
    """Return the step from `here` to `there`: position (m) and rotation vector (rad), base axes."""
    turn = to_vector(compose(there.rotation, transpose(here.rotation)))
    return (*subtract(there.origin, here.origin), *turn)


def tcp_in_base(arm: PlantArm, q: Sequence[float], tool: Frame) -> Frame:
    """Return the TCP of the rigid arm, in base."""
    return place(arm.flange(q), tool)


def jacobian(arm: PlantArm, q: Sequence[float], tool: Frame) -> np.ndarray:
    """Return the (6, n) Jacobian of the TCP in base axes: position rows, then rotation rows."""
    frames = arm.frames(q)
    tip = place(frames[-1], tool).origin
    columns = []
    for frame in frames[:-1]:
        r = frame.rotation
        axis = (r[2], r[5], r[8])
        columns.append((*cross(axis, subtract(tip, frame.origin)), *axis))
    return np.array(columns).T


def solve(
    arm: PlantArm, target: Frame, near: Sequence[float], tool: Frame, steps: int = 60
) -> Joints | None:
    """Return the joints (n, rad), found from `near`, that bring the TCP to `target`, or None.

    Newton steps with a little damping; each joint moves at most 0.3 rad a step.
    """
    q = [float(v) for v in near]
    for _ in range(steps):
        step = gap(tcp_in_base(arm, q, tool), target)
        if max(map(abs, step)) < 1e-11:
            return tuple(q)
        J = jacobian(arm, q, tool)
        damping = min(1e-4, 1e-2 * float(np.dot(step, step)))
        change = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6) + 1e-14 * np.eye(6), step)
        largest = float(np.abs(change).max())
        if largest > 0.3:
            change *= 0.3 / largest
        q = [a + float(b) for a, b in zip(q, change, strict=True)]
    error = gap(tcp_in_base(arm, q, tool), target)
    return tuple(q) if max(map(abs, error)) < 1e-7 else None


def between(start: Frame, end: Frame, share: float) -> Frame:
    """Return the frame at `share` (0..1) of a straight path with constant rotation rate."""
    step = gap(start, end)
    turn = from_vector((step[3] * share, step[4] * share, step[5] * share))
    shift: Vector3 = (step[0] * share, step[1] * share, step[2] * share)
    return Frame(compose(turn, start.rotation), add(start.origin, shift))


def offset_frame(frame: Frame, offset: Sequence[float]) -> Frame:
    """Return `frame` shifted by `offset` and turned by it about its own origin, base axes."""
    turn = from_vector((offset[3], offset[4], offset[5]))
    return Frame(compose(turn, frame.rotation), add(frame.origin, offset[:3]))


def holding_torque(
    arm: PlantArm,
    q: Sequence[float],
    gravity: Vector3,
    mass: float,
    cog: Vector3,
    wrench: Sequence[float],
    tool: Frame,
) -> Joints:
    """Return the joint torques (n, Nm) that hold the rigid arm under weight and load."""
    frames = arm.frames(q)
    flange = frames[-1]
    tip = place(flange, tool).origin
    centre = add(flange.origin, rotate(flange.rotation, cog))
    weight = scale(gravity, mass)
    force = add(weight, wrench[:3])
    moment = add(add(cross(centre, weight), cross(tip, wrench[:3])), wrench[3:])
    torques: list[float] = []
    for i in reversed(range(len(arm.mass))):
        r, origin = frames[i].rotation, frames[i].origin
        lever = add(origin, rotate(r, arm.cog[i]))
        pull = scale(gravity, arm.mass[i])
        force, moment = add(force, pull), add(moment, cross(lever, pull))
        here = subtract(moment, cross(origin, force))
        torques.append(-(here[0] * r[2] + here[1] * r[5] + here[2] * r[8]))
    return tuple(reversed(torques))


def within_limits(arm: PlantArm, q: Sequence[float]) -> bool:
    """Return whether finite joints lie inside the arm's limits."""
    return all(
        math.isfinite(v) and lo <= v <= hi
        for v, lo, hi in zip(q, arm.lower, arm.upper, strict=True)
    )
