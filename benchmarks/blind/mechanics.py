"""The real arm at rest: exact finite rotations, loads in the deflected shape, to equilibrium.

Written for the benchmark alone and from the physics, on standard DH rows; nothing of the product is
used here. All arrays carry the poses first: (N, ...). Units are SI, temperatures degrees Celsius.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
EQUILIBRIUM = 1e-12  # rad, change of the deflections at which the shape stands still


@dataclass(frozen=True)
class Row:
    """One standard DH row, the mass behind it, and where that mass sits (in the row's frame)."""

    a: float
    alpha: float
    d: float
    offset: float = 0.0
    mass: float = 0.0
    cog: tuple[float, float, float] = (0.0, 0.0, 0.0)
    beta: float = 0.0  # twist about the row's y axis


@dataclass(frozen=True)
class Session:
    """What happened at each of N poses: what the log holds, as it truly was."""

    time: Array  # (N,) s
    q: Array  # (N, n) rad, encoder angles
    payload_mass: Array  # (N,) kg
    payload_cog: Array  # (N, 3) m, flange frame
    tcp_wrench: Array  # (N, 6) N, Nm, on the tool, at the TCP, base axes
    temperature: Array  # (N, n)
    approach: Array  # (N, n) sign of each joint's last motion
    from_where: Array  # (N, n) rad, the angle from which each joint came last

    def permuted(self, column: str, rng: np.random.Generator) -> Session:
        """Return the session with the values of one log column shuffled over the poses."""
        name, _, index = column.rpartition("_")
        order = rng.permutation(len(self.time))
        if column in ("payload", "timestamp"):
            key = "payload_mass" if column == "payload" else "time"
            return replace(self, **{key: getattr(self, key)[order]})
        key = LOG_FIELDS[name]
        values = getattr(self, key).copy()
        values[:, int(index)] = values[order, int(index)]
        changed = replace(self, **{key: values})
        overshoot = np.abs(self.q - self.from_where)
        return replace(changed, from_where=changed.q - overshoot * changed.approach)


LOG_FIELDS = {
    "actual_q": "q",
    "joint_temperatures": "temperature",
    "approach": "approach",
    "actual_TCP_force": "tcp_wrench",
    "payload_cog": "payload_cog",
}
AngleError = Callable[[Session], Array]  # -> (N, n) rad, true joint angle minus encoder angle
ToolShift = Callable[[Session, Array], Array]  # (session, gravity in flange (N, 3)) -> (N, 3) m
Pull = Callable[[Session, Array, Array], Array]  # (session, flange p, flange R) -> (N, 6) at flange
BaseRotation = Callable[[Session], Array]  # -> (N, 3) rad, rotation vector of the base


@dataclass(frozen=True)
class RealArm:
    """An arm as it is; every field can be other than the drawing says."""

    rows: tuple[Row, ...]
    tool_position: Array  # (3,) in the flange
    tool_rotation: Array  # (3, 3)
    axial: Array  # (n,) rad/Nm
    radial: Array  # (n,) rad/Nm
    gravity: Array  # (3,) m/s2
    deflected: dict[int, tuple[float, float]] = field(default_factory=dict)  # joint: (rad/Nm, Nm)
    link_softness: Array | None = None  # (n,) 1/EI, 1/(N m2)
    base_softness: tuple[float, float] = (0.0, 0.0)  # rad/Nm about x and y of base
    more_payload: float = 0.0  # kg
    payload_shift: Array = field(default_factory=lambda: np.zeros(3))  # m, flange axes
    expansion: float = 0.0  # 1/K
    reference_temperature: float = 25.0
    angle_errors: tuple[AngleError, ...] = ()
    tool_shifts: tuple[ToolShift, ...] = ()
    pulls: tuple[Pull, ...] = ()
    base_tilts: tuple[BaseRotation, ...] = ()

    @property
    def n(self) -> int:
        """Return the number of joints."""
        return len(self.rows)

    @property
    def soft(self) -> bool:
        """Return whether anything gives way under load."""
        links = self.link_softness is not None and bool(np.any(self.link_softness))
        joints = bool(np.any(self.axial)) or bool(np.any(self.radial)) or bool(self.deflected)
        return links or joints or bool(np.any(self.base_softness))


@dataclass
class Shape:
    """Where everything stands: joint frames after rotation and bending, flange and TCP, in base."""

    origin: Array  # (n, N, 3) of each joint
    axes: Array  # (n, N, 3, 3) of each joint, after its rotation and bending
    end: Array  # (n, N, 3) the far end of each link
    cog: Array  # (n, N, 3) of each link
    flange_position: Array  # (N, 3)
    flange_rotation: Array  # (N, 3, 3)
    tcp: Array  # (N, 3)
    tcp_rotation: Array  # (N, 3, 3)


def turn(vector: Array) -> Array:
    """Return the rotation matrices (N, 3, 3) of rotation vectors (N, 3): Rodrigues, exact."""
    angle = np.linalg.norm(vector, axis=1)[:, None, None]
    x, y, z = vector.T
    k = np.zeros((len(vector), 3, 3))
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -z, y, -x
    k[:, 1, 0], k[:, 2, 0], k[:, 2, 1] = z, -y, x
    safe = np.where(angle > 1e-9, angle, 1.0)
    first = np.where(angle > 1e-9, np.sin(angle) / safe, 1.0)
    half = np.sin(angle / 2) / safe
    second = np.where(angle > 1e-9, 2 * half * half, 0.5)
    return np.eye(3) + first * k + second * (k @ k)


def turn_z(angle: Array) -> Array:
    """Return rotations about z (N, 3, 3)."""
    out = np.zeros((len(angle), 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = np.cos(angle)
    out[:, 1, 0] = np.sin(angle)
    out[:, 0, 1] = -out[:, 1, 0]
    out[:, 2, 2] = 1.0
    return out


def cross(a: Array, b: Array) -> Array:
    """Return the vector product along the last axis; leaner than numpy's for small arrays."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def _apply(rotation: Array, vector: Array) -> Array:
    return (rotation @ vector[..., None])[..., 0]


def _back(rotation: Array, vector: Array) -> Array:
    return (vector[:, None, :] @ rotation)[:, 0, :]


@dataclass
class _Bend:
    """Deflections that the loads ask for: per joint, per link, of the base."""

    joint: Array  # (n, N, 3) rad, joint axes
    link_shift: Array  # (n, N, 3) m, link axes
    link_turn: Array  # (n, N, 3) rad, link axes
    base: Array  # (N, 3) rad

    @classmethod
    def none(cls, n: int, poses: int) -> _Bend:
        return cls(np.zeros((n, poses, 3)), np.zeros((n, poses, 3)), np.zeros((n, poses, 3)),
                   np.zeros((poses, 3)))  # fmt: skip

    def far_from(self, other: _Bend) -> float:
        return float(
            max(
                np.abs(self.joint - other.joint).max(),
                np.abs(self.link_shift - other.link_shift).max(),
                np.abs(self.link_turn - other.link_turn).max(),
                np.abs(self.base - other.base).max(),
            )
        )


def stand(arm: RealArm, session: Session) -> Shape:
    """Return the arm's shape at every pose, at rest under all its loads."""
    angle = session.q + sum((e(session) for e in arm.angle_errors), np.zeros_like(session.q))
    bend = _Bend.none(arm.n, len(angle))
    shape = _place(arm, session, angle, bend)
    if not arm.soft:
        return shape
    for _ in range(60):
        wanted = _wanted_bend(arm, session, shape)
        step = wanted.far_from(bend)
        bend = wanted
        shape = _place(arm, session, angle, bend)
        if step < EQUILIBRIUM:
            return shape
    raise RuntimeError("the arm found no equilibrium: it is too soft for its loads")


def _place(arm: RealArm, session: Session, angle: Array, bend: _Bend) -> Shape:
    """Return the shape for given joint angles and deflections."""
    n, poses = arm.n, len(angle)
    base_rotation = bend.base + sum((t(session) for t in arm.base_tilts), np.zeros((poses, 3)))
    rotation, position = turn(base_rotation), np.zeros((poses, 3))
    origin, end, cog = (np.empty((n, poses, 3)) for _ in range(3))
    axes = np.empty((n, poses, 3, 3))
    soft = arm.soft
    soft_links = arm.link_softness is not None and bool(np.any(arm.link_softness))
    warmth = arm.expansion * (session.temperature - arm.reference_temperature)
    for i, row in enumerate(arm.rows):
        origin[i] = position
        rotation = rotation @ turn_z(angle[:, i] + row.offset)
        if soft:
            rotation = rotation @ turn(bend.joint[i])
        axes[i] = rotation
        twist = turn(np.array([[row.alpha, 0, 0]]))[0]
        if row.beta:
            twist = twist @ turn(np.array([[0, row.beta, 0]]))[0]
        reach = np.array([row.a, 0.0, row.d])
        cog[i] = position + rotation @ (reach + twist @ np.array(row.cog))
        # the last row's end is the flange: it belongs to link n and grows like the others
        end_in_link = reach * (1.0 + warmth[:, i, None]) + bend.link_shift[i]
        position = position + _apply(rotation, end_in_link)
        end[i] = position
        if soft_links:
            rotation = rotation @ turn(bend.link_turn[i])
        rotation = rotation @ twist
    shift = np.tile(arm.tool_position, (poses, 1))
    if arm.tool_shifts:
        down = _back(rotation, np.tile(arm.gravity, (poses, 1)))
        shift = shift + sum((s(session, down) for s in arm.tool_shifts), np.zeros((poses, 3)))
    tcp = position + _apply(rotation, shift)
    return Shape(origin, axes, end, cog, position, rotation, tcp, rotation @ arm.tool_rotation)


@dataclass(frozen=True)
class Loads:
    """Resultants of everything from link k on (k from 0; the last entries hold no link)."""

    force: Array  # (n + 1, N, 3) N
    moment: Array  # (n + 1, N, 3) Nm, about the base's origin

    def about(self, point: Array, first_link: int) -> Array:
        """Return the moment (N, 3) about a point of everything from ``first_link`` on."""
        return np.asarray(self.moment[first_link] - cross(point, self.force[first_link]))


def loads_of(arm: RealArm, session: Session, shape: Shape) -> Loads:
    """Return the resultants of weights, payload and pulls in this shape."""
    n, poses = arm.n, len(session.q)
    weights = np.array([row.mass for row in arm.rows])[:, None, None] * arm.gravity
    force = np.concatenate([np.broadcast_to(weights, (n, poses, 3)), np.zeros((1, poses, 3))])
    moment = np.zeros((n + 1, poses, 3))
    moment[:n] = cross(shape.cog, force[:n])
    carried = (session.payload_mass + arm.more_payload)[:, None] * arm.gravity
    where = shape.flange_position + _apply(
        shape.flange_rotation, session.payload_cog + arm.payload_shift
    )
    force[n] = carried + session.tcp_wrench[:, :3]
    moment[n] = cross(where, carried) + cross(shape.tcp, session.tcp_wrench[:, :3])
    moment[n] += session.tcp_wrench[:, 3:]
    for pull in arm.pulls:
        extra = pull(session, shape.flange_position, shape.flange_rotation)
        force[n] += extra[:, :3]
        moment[n] += extra[:, 3:] + cross(shape.flange_position, extra[:, :3])
    beyond = np.cumsum(force[::-1], axis=0)[::-1], np.cumsum(moment[::-1], axis=0)[::-1]
    return Loads(*beyond)


def _wanted_bend(arm: RealArm, session: Session, shape: Shape) -> _Bend:
    """Return the deflections under the loads of a shape."""
    n, poses = arm.n, len(session.q)
    bend = _Bend.none(n, poses)
    loads = loads_of(arm, session, shape)
    for i in range(n):
        local = _back(shape.axes[i], loads.about(shape.origin[i], i))
        bend.joint[i, :, :2] = arm.radial[i] * local[:, :2]
        bend.joint[i, :, 2] = arm.axial[i] * local[:, 2]
        if i in arm.deflected:
            soft, knee = arm.deflected[i]
            bend.joint[i, :, 2] += soft * local[:, 2] / np.hypot(1.0, local[:, 2] / knee)
        if arm.link_softness is not None and arm.link_softness[i]:
            bend.link_shift[i], bend.link_turn[i] = _cantilever(arm, loads, shape, i)
    if any(arm.base_softness):
        bend.base[:, :2] = loads.moment[0][:, :2] * np.array(arm.base_softness)
    return bend


def _cantilever(arm: RealArm, loads: Loads, shape: Shape, i: int) -> tuple[Array, Array]:
    """Return shift and slope (link axes) of the far end of link i, clamped in joint i."""
    assert arm.link_softness is not None
    reach = np.array([arm.rows[i].a, 0.0, arm.rows[i].d])
    length = float(np.linalg.norm(reach))
    if length == 0.0:
        return np.zeros_like(shape.end[i]), np.zeros_like(shape.end[i])
    along = reach / length
    force = _back(shape.axes[i], loads.force[i + 1])
    moment = _back(shape.axes[i], loads.about(shape.end[i], i + 1))
    across = force - (force @ along)[:, None] * along
    bending = moment - (moment @ along)[:, None] * along  # a beam in bending does not twist
    soft = arm.link_softness[i]
    shift = soft * (across * length**3 / 3 + cross(bending, along) * length**2 / 2)
    slope = soft * (cross(along, across) * length**2 / 2 + bending * length)
    return shift, slope
