"""What a sensor on the flange measures, in its own axes: shares no mathematics with the driver."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from gapbridge.drivers.simulated.plant.plant_settings import Vector6
from gapbridge.drivers.simulated.plant.rotations import (
    Vector3,
    compose,
    cross,
    from_vector,
    subtract,
    unrotate,
)

Reaction = Callable[[], Vector6]
"""Returns the wrench that a sensor measures now, N and Nm, in its own axes, about its origin."""


def reaction_at(
    in_flange: Callable[[], Sequence[float]], xyz: Vector3, rpy: Vector3, sign: int = 1
) -> Reaction:
    """Return what a sensor mounted at ``xyz``, ``rpy`` measures of the flange's wrench (6,).

    ``sign`` -1: it reports the reaction.
    """
    roll, pitch, yaw = (
        from_vector(tuple(angle if i == axis else 0.0 for i in range(3)))
        for axis, angle in enumerate(rpy)
    )
    rotation = compose(yaw, compose(pitch, roll))

    def reaction() -> Vector6:
        a, b, c, d, e, f = in_flange()
        force = (a, b, c)
        torque = subtract((d, e, f), cross(xyz, force))
        found = (*unrotate(rotation, force), *unrotate(rotation, torque))
        u, v, w, x, y, z = (sign * value for value in found)
        return (u, v, w, x, y, z)

    return reaction
