"""The arm of the plant and its controller, independent of core's mathematics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gapbridge.core.arm import Arm, builtin_arm
from gapbridge.core.errors import ArmError
from gapbridge.drivers.simulated.plant.rotations import (
    IDENTITY,
    Rotation,
    Vector3,
    add,
    compose,
    rotate,
    turn_z,
)

FASTEST = 6.2831853  # rad/s, for an arm without velocity limits


class Frame(NamedTuple):
    """A frame in base: rotation and origin (m)."""

    rotation: Rotation
    origin: Vector3


BASE = Frame(IDENTITY, (0.0, 0.0, 0.0))


def place(outer: Frame, inner: Frame) -> Frame:
    """Return `inner`, which is given in `outer`, in the frame that `outer` is given in."""
    return Frame(
        compose(outer.rotation, inner.rotation),
        add(outer.origin, rotate(outer.rotation, inner.origin)),
    )


@dataclass(frozen=True, slots=True)
class PlantArm:
    """An arm of any number of turning joints.

    ``links`` are n + 1 fixed frames: base to joint 1 at zero, link i to joint i + 1, link n to
    flange; every joint turns about its own z. ``cog`` (m) is in the link's own joint frame.
    """

    name: str
    links: tuple[Frame, ...]
    mass: tuple[float, ...]  # kg
    cog: tuple[Vector3, ...]  # m
    lower: tuple[float, ...]  # rad
    upper: tuple[float, ...]  # rad
    velocity: tuple[float, ...]  # rad/s

    @property
    def reach(self) -> float:
        """Length of the stretched chain, m."""
        return sum(math.dist(link.origin, (0.0, 0.0, 0.0)) for link in self.links)

    def frames(self, q: Sequence[float]) -> list[Frame]:
        """Return the n joint frames (after their own rotation) and the flange, rigid, in base."""
        result: list[Frame] = []
        rotation, origin = IDENTITY, (0.0, 0.0, 0.0)
        for i, link in enumerate(self.links):
            origin = add(origin, rotate(rotation, link.origin))
            rotation = compose(rotation, link.rotation)
            if i < len(q):
                rotation = turn_z(rotation, q[i])
            result.append(Frame(rotation, origin))
        return result

    def flange(self, q: Sequence[float]) -> Frame:
        """Return the flange of the rigid arm in base."""
        # ``frames`` written out: this runs a few times in every cycle of every controller
        r0, r1, r2, r3, r4, r5, r6, r7, r8 = IDENTITY
        x = y = z = 0.0
        for link, angle in zip(self.links, q, strict=False):
            u, v, w = link.origin
            x += r0 * u + r1 * v + r2 * w
            y += r3 * u + r4 * v + r5 * w
            z += r6 * u + r7 * v + r8 * w
            b0, b1, b2, b3, b4, b5, b6, b7, b8 = link.rotation
            c, s = math.cos(angle), math.sin(angle)
            e, f = r0 * b0 + r1 * b3 + r2 * b6, r0 * b1 + r1 * b4 + r2 * b7
            r0, r1, r2 = e * c + f * s, f * c - e * s, r0 * b2 + r1 * b5 + r2 * b8
            e, f = r3 * b0 + r4 * b3 + r5 * b6, r3 * b1 + r4 * b4 + r5 * b7
            r3, r4, r5 = e * c + f * s, f * c - e * s, r3 * b2 + r4 * b5 + r5 * b8
            e, f = r6 * b0 + r7 * b3 + r8 * b6, r6 * b1 + r7 * b4 + r8 * b7
            r6, r7, r8 = e * c + f * s, f * c - e * s, r6 * b2 + r7 * b5 + r8 * b8
        rotation = (r0, r1, r2, r3, r4, r5, r6, r7, r8)
        return place(Frame(rotation, (x, y, z)), self.links[-1])


def _vector3(values: Sequence[float]) -> Vector3:
    x, y, z = (float(v) for v in values)
    return (x, y, z)


def _frame(matrix: Sequence[Sequence[float]]) -> Frame:
    """Return the frame of a 4 x 4 transform."""
    r = [[float(v) for v in row] for row in matrix]
    rotation: Rotation = (
        r[0][0], r[0][1], r[0][2], r[1][0], r[1][1], r[1][2], r[2][0], r[2][1], r[2][2],
    )  # fmt: skip
    return Frame(rotation, (r[0][3], r[1][3], r[2][3]))


def plant_arm(arm: Arm | str, joints: int | None = None) -> PlantArm:
    """Return the plant's arm from the data of a nominal arm, or of a built-in one by its name.

    Raises ArmError where it has not `joints` joints (None: any number will do).
    """
    if isinstance(arm, str):
        arm = builtin_arm(arm)
    if joints is not None and arm.n != joints:
        raise ArmError(f"robot: found {arm.n} joints, expected {joints}: the controller has those")
    limits = arm.limits
    return PlantArm(
        name=arm.name,
        links=tuple(_frame(matrix) for matrix in arm.link_in_link.tolist()),
        mass=tuple(arm.mass.tolist()),
        cog=tuple(_vector3(row) for row in arm.cog.tolist()),
        lower=tuple(limits.lower.tolist()),
        upper=tuple(limits.upper.tolist()),
        velocity=tuple(np.minimum(limits.velocity, FASTEST).tolist()),
    )
