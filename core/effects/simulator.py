"""The change of a simulator's model that represents an effect, in the simulator's terms."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum, auto


class Kind(Enum):
    """A quantity that simulators know."""

    JOINT_ZERO = auto()  # rad: the joint turns further than its encoder says
    FRICTION = auto()  # Nm, Coulomb
    DAMPING = auto()  # Nm s/rad
    ARMATURE = auto()  # kg m2: inertia of the rotor at the joint's side of the gear
    DELAY = auto()  # s, of the command
    LAG = auto()  # s: time constant of the servo
    SERVO_COMPLIANCE = auto()  # rad/Nm: 1 / proportional gain of a position servo
    PLAY = auto()  # rad: whole clearance
    PAYLOAD = auto()  # kg, at the declared centre of gravity
    PAYLOAD_COG = auto()  # m, flange axes: shift of the load's centre of gravity
    LINK_SCALE = auto()  # relative increase of a link's mass and inertia
    LINK_MOMENT = auto()  # kg m, the joint's frame: a link's mass times the shift of its centre
    SENSOR_TURN = auto()  # rad, flange axes: rotation vector of the flange sensor's own axes


@dataclass(frozen=True)
class SimulatorChange:
    """One change: by ``value`` in the kind's unit, at a joint (from 1) or the whole arm."""

    kind: Kind
    joint: int | None
    value: float
    axis: int | None = None  # 0, 1, 2 of the kind's axes, where it is a part of a vector


def along_axes(
    kind: Kind, joint: int | None, vector: Iterable[float]
) -> tuple[SimulatorChange, ...]:
    """Return one change an axis of a vector (3,) that is not zero."""
    return tuple(SimulatorChange(kind, joint, float(v), k) for k, v in enumerate(vector) if v)
