"""Effects that stand in no catalogue: of one joint, the tool, the load, the instrument, the room.

Each is given with the log columns that it truly depends on. ``strength`` is set afterwards by the
size of the gap, as for the known effects.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from benchmarks.blind.bench import Bench
from benchmarks.blind.measuring import without
from benchmarks.blind.mechanics import Array, RealArm, Session, stand

TIME = ("timestamp",)
Reading = Callable[[Session, Array, float], Array]  # tracker-frame positions -> what is read


@dataclass(frozen=True)
class Outside:
    """One effect outside the catalogue at one cell."""

    name: str
    depends_on: tuple[str, ...]
    arm: Callable[[RealArm, float], RealArm] = lambda arm, strength: arm
    read: Reading | None = None
    ratio: tuple[float, float] = (3.0, 10.0)
    first: float = 1e-4  # a strength to start sizing from
    akin: tuple[tuple[str, int | None], ...] = ()  # what may be accused with the rest admitted
    near: tuple[tuple[str, int | None], ...] = ()  # where no known effect is distinguished from it


def angle_of(joint: int, shape: Callable[[Session], Array]) -> Callable[[RealArm, float], RealArm]:
    """Return a change of the arm: joint (from 0) turns further by strength x shape."""

    def change(arm: RealArm, strength: float) -> RealArm:
        def error(session: Session) -> Array:
            out = np.zeros_like(session.q)
            out[:, joint] = strength * shape(session)
            return out

        return replace(arm, angle_errors=(*arm.angle_errors, error))

    return change


def _shown_joint(bench: Bench, rng: Generator, low: int = 1) -> int:
    """Return a joint (from 0) that shows well: neither the first nor the last."""
    return int(rng.integers(low, bench.kind.n - 1))


def chipped_tooth(bench: Bench, rng: Generator) -> Outside:
    """Return a local bump in one joint's angle."""
    j = _shown_joint(bench, rng)
    centre = float(rng.choice(bench.session.q[5:-5, j]))
    width = rng.uniform(0.1, 0.22)

    def bump(s: Session) -> Array:
        return np.asarray(np.exp(-0.5 * ((s.q[:, j] - centre) / width) ** 2))

    return Outside("chipped_tooth", (f"actual_q_{j}",), angle_of(j, bump), ratio=(3.0, 6.0))


def encoder_scale(bench: Bench, rng: Generator) -> Outside:
    """Return an encoder that counts too many steps on one side of a point: a kink."""
    j = _shown_joint(bench, rng)
    start = float(np.quantile(bench.session.q[:, j], rng.uniform(0.3, 0.6)))

    def kink(s: Session) -> Array:
        return np.maximum(s.q[:, j] - start, 0.0)

    return Outside("encoder_scale", (f"actual_q_{j}",), angle_of(j, kink))


def cross_coupling(bench: Bench, rng: Generator) -> Outside:
    """Return a joint whose angle is carried along by another joint's."""
    driver = _shown_joint(bench, rng)
    driven = driver + 1 if driver + 1 < bench.kind.n - 1 else driver - 1

    def carried(s: Session) -> Array:
        return s.q[:, driver] - 0.3 * s.q[:, driver] ** 2

    return Outside("cross_coupling", (f"actual_q_{driver}",), angle_of(driven, carried))


def joint_creep(bench: Bench, rng: Generator) -> Outside:
    """Return a joint that creeps on its shaft for a while in the session: no step, a ramp."""
    j = _shown_joint(bench, rng)
    start, end = np.quantile(bench.session.time, [rng.uniform(0.1, 0.3), rng.uniform(0.6, 0.9)])
    return Outside("joint_creep", TIME, angle_of(
        j, lambda s: np.clip((s.time - start) / (end - start), 0.0, 1.0)))  # fmt: skip


def tracker_knocked(bench: Bench, rng: Generator) -> Outside:
    """Return a tracker that is knocked in mid-session: a step and a small turn."""
    when = float(np.quantile(bench.session.time, rng.uniform(0.25, 0.75)))
    step, turn = rng.normal(size=3), rng.normal(size=3) * 0.3

    def read(s: Session, p: Array, strength: float) -> Array:
        after = (s.time > when)[:, None]
        return p + after * strength * (step + np.cross(turn, p))

    return Outside("tracker_knocked", TIME, read=read)


def tracker_drift(bench: Bench, rng: Generator) -> Outside:
    """Return a tracker that settles while it warms up."""
    way = rng.normal(size=3)
    pace = bench.session.time[-1] * rng.uniform(0.15, 0.5)

    def read(s: Session, p: Array, strength: float) -> Array:
        return np.asarray(p + strength * np.exp(-s.time / pace)[:, None] * way)

    return Outside("tracker_drift", TIME, read=read)


def _station(bench: Bench, rng: Generator) -> Array:
    """Return where the tracker head stands, in the frame of its readings."""
    if not bench.instrument.registered:
        return np.zeros(3)
    away = rng.normal(size=3) * [1, 1, 0.2]
    return np.asarray(away / np.linalg.norm(away) * rng.uniform(2.5, 4.0))


def tracker_refraction(bench: Bench, rng: Generator) -> Outside:
    """Return a beam that bends in layered air: height errors that grow with distance squared."""
    head, up = _station(bench, rng), rng.normal(size=3)
    up = up / np.linalg.norm(up) if not bench.instrument.registered else np.array([0, 0, 1.0])

    def read(s: Session, p: Array, strength: float) -> Array:
        distance = np.linalg.norm(p - head, axis=1)
        return np.asarray(p + strength * (distance**2)[:, None] * up)

    return Outside("tracker_refraction", _reading_columns(bench, read), read=read, first=1e-3)


def tracker_eccentric(bench: Bench, rng: Generator) -> Outside:
    """Return a tracker whose azimuth circle is off centre: errors periodic in azimuth."""
    head, phase = _station(bench, rng), rng.uniform(-np.pi, np.pi)
    order = 6 if bench.instrument.registered else 4

    def read(s: Session, p: Array, strength: float) -> Array:
        beam = p - head
        azimuth = np.arctan2(beam[:, 1], beam[:, 0])
        across = np.column_stack([-beam[:, 1], beam[:, 0], 0 * azimuth])
        return np.asarray(p + strength * np.sin(order * azimuth + phase)[:, None] * across)

    return Outside("tracker_eccentric", _reading_columns(bench, read), read=read)


def loose_tool(bench: Bench, rng: Generator) -> Outside:
    """Return a tool that tips over in its holder as gravity changes side."""
    side, way = rng.normal(size=3), rng.normal(size=3)
    side /= np.linalg.norm(side)

    def shift(s: Session, down: Array) -> Array:
        return np.tanh(3 * down @ side / 9.80665)[:, None] * way

    def change(arm: RealArm, strength: float) -> RealArm:
        return replace(
            arm, tool_shifts=(*arm.tool_shifts, lambda s, down: strength * shift(s, down))
        )

    def latent(s: Session) -> Array:
        rotation = stand(bench.nominal, s).flange_rotation
        return shift(s, np.einsum("nji,j->ni", rotation, bench.nominal.gravity))

    return Outside("loose_tool", _columns_of(bench, latent), change)


def tool_plate(bench: Bench, rng: Generator) -> Outside:
    """Return a tool plate that seats differently under each payload."""
    way = rng.normal(size=3)
    rated = bench.kind.rated

    def shift(s: Session, down: Array) -> Array:
        return np.sqrt(s.payload_mass / rated)[:, None] * way

    def change(arm: RealArm, strength: float) -> RealArm:
        return replace(
            arm, tool_shifts=(*arm.tool_shifts, lambda s, down: strength * shift(s, down))
        )

    return Outside("tool_plate", ("payload",), change)


def hose(bench: Bench, rng: Generator) -> Outside:
    """Return a hose that tightens as one wrist joint winds it up, and pulls at the flange."""
    j = bench.kind.n - int(rng.integers(1, 4))
    start = float(np.quantile(bench.session.q[:, j], rng.uniform(0.2, 0.5)))
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)

    def change(arm: RealArm, strength: float) -> RealArm:
        def pull(s: Session, position: Array, rotation: Array) -> Array:
            tight = strength * np.maximum(s.q[:, j] - start, 0.0)
            return np.column_stack([tight[:, None] * way, np.zeros((len(tight), 3))])

        return replace(arm, pulls=(*arm.pulls, pull))

    return Outside("hose", (f"actual_q_{j}",), change, first=1.0)


def tower_bending(bench: Bench, rng: Generator) -> Outside:
    """Return a tower that bends as it warms, and tilts the base."""
    angle = rng.uniform(-np.pi, np.pi)
    axis = np.array([np.cos(angle), np.sin(angle), 0.0])

    def change(arm: RealArm, strength: float) -> RealArm:
        def base_rotation(s: Session) -> Array:
            return np.asarray(strength * (s.temperature[:, :1] - arm.reference_temperature) * axis)

        return replace(arm, base_tilts=(*arm.base_tilts, base_rotation))

    # all joints warm up together: one temperature is as good as the other, and as time
    columns = tuple(f"joint_temperatures_{i}" for i in range(bench.kind.n))
    return Outside("tower_bending", (*columns, "timestamp"), change, first=1e-5)


OUTSIDE = {
    make.__name__: make
    for make in (
        chipped_tooth, encoder_scale, cross_coupling, joint_creep, tracker_knocked, tracker_drift,
        tracker_refraction, tracker_eccentric, loose_tool, tool_plate, hose, tower_bending,
    )
}  # fmt: skip
NEED_COMPLIANCE = ("hose",)


def _reading_columns(bench: Bench, read: Reading) -> tuple[str, ...]:
    """Return the measured positions, and the joints that move the reading error most."""

    def latent(s: Session) -> Array:
        base = stand(bench.nominal, s).tcp
        seen = base @ bench.instrument.rotation.T + bench.instrument.position
        return read(s, seen, 1.0) - seen

    return (*(f"measured_position_{k}" for k in range(3)), *_columns_of(bench, latent))


def _columns_of(bench: Bench, latent: Callable[[Session], Array]) -> tuple[str, ...]:
    """Return the joint columns whose shuffling changes a quantity most (total-effect indices)."""
    rng = np.random.default_rng(0)
    session = bench.session
    ones = np.tile(np.eye(3), (len(session.q), 1))
    values = without(ones, latent(session).ravel())
    spread = float(values @ values)
    effect = {}
    for j in range(bench.kind.n):
        column = f"actual_q_{j}"
        other = without(ones, latent(session.permuted(column, rng)).ravel())
        effect[column] = float(np.sum((values - other) ** 2)) / max(2 * spread, 1e-30)
    most = max(effect.values())
    return tuple(c for c, e in effect.items() if e > 0.3 * most)
