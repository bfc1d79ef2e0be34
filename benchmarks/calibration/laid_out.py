"""Simulated sessions: the truth by the blind benchmark's mechanics, readings as the product's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.blind.arms import ArmKind
from benchmarks.blind.measuring import Instrument, joint_lever, read_arm
from benchmarks.blind.mechanics import RealArm, Session, stand, turn
from benchmarks.calibration.drawings import real_arm, session_at
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.loads import Loads

Index = NDArray[np.int64]
SPREAD = {"a": 5e-4, "d": 5e-4, "alpha": 8e-4, "beta": 8e-4}  # m and rad, 1 sigma
OFFSET, TOOL, TOOL_TURN = 1e-3, 1e-3, 2e-3
SOFT = (0.6, 1.5)  # of the class's usual softness
LOADS = (0.05, 0.5, 0.95)  # of the rated load
FLOOR = (2.2e-5, 4.5e-5)  # m, instrument and arm together, one coordinate


@dataclass(frozen=True)
class Layout:
    """How a session is laid out."""

    poses: int = 20  # to fit, each under every load
    repeated: int = 3  # of them measured twice
    held_out: int = 15
    pose_kind: bool = False  # True: rotations are measured too
    registered: bool = False
    sigma: float = 2e-5  # m


def draw_values(kind: ArmKind, names: Sequence[str], rng: Generator) -> dict[str, float]:
    """Return true values of the named parameters: what the arm has beyond its drawing."""
    return {name: _value(kind, name, rng) for name in names}


def _value(kind: ArmKind, name: str, rng: Generator) -> float:
    effect, joint, key = parts_of(name)
    if effect == "joint_offset":
        return float(OFFSET * rng.normal())
    if effect == "link_geometry":
        return float(SPREAD[key] * rng.normal())
    if effect == "tool_frame":
        return float((TOOL_TURN if key.startswith("r") else TOOL) * rng.normal())
    usual = kind.axial if effect == "axial_compliance" else kind.radial
    return float(usual[joint - 1] * rng.uniform(*SOFT))


def parts_of(name: str) -> tuple[str, int, str]:
    """Return effect, joint (0: none) and key of a parameter's name."""
    parts = name.split("_")
    effect, rest = "_".join(parts[:2]), parts[2:]
    joint = int(rest[0]) if rest and rest[0].isdigit() else 0
    return effect, joint, rest[-1] if rest and not rest[-1].isdigit() else ""


def arm_with(kind: ArmKind, values: Mapping[str, float]) -> RealArm:
    """Return the real arm with these values beyond its drawing."""
    return with_values(real_arm(kind), values)


def with_values(real: RealArm, values: Mapping[str, float]) -> RealArm:
    """Return an arm with these values beyond what it has."""
    rows, axial, radial = list(real.rows), real.axial.copy(), real.radial.copy()
    shift, twist = np.zeros(3), np.zeros(3)
    for name, value in values.items():
        effect, joint, key = parts_of(name)
        i = joint - 1
        if effect == "joint_offset":
            rows[i] = replace(rows[i], offset=rows[i].offset + value)
        elif effect == "link_geometry":
            changed: dict[str, float] = {key: float(getattr(rows[i], key)) + value}
            rows[i] = replace(rows[i], **changed)  # type: ignore[arg-type]
        elif effect == "tool_frame":
            (twist if key.startswith("r") else shift)["xyz".index(key[-1])] += value
        else:
            (axial if effect == "axial_compliance" else radial)[i] += value
    return replace(
        real, rows=tuple(rows), axial=axial, radial=radial,
        tool_position=real.tool_position + shift,
        tool_rotation=turn(twist[None])[0] @ real.tool_rotation,
    )  # fmt: skip


def instrument_for(kind: ArmKind, layout: Layout, rng: Generator) -> Instrument:
    """Return a tracker somewhere, and how well the arm repeats."""
    floor = rng.uniform(*FLOOR)
    shape = stand(real_arm(kind), session_at(rng.uniform(kind.low, kind.high, (30, kind.n))))
    lever = float((joint_lever(shape) ** 2).sum(axis=0).mean())
    free = not layout.registered
    return Instrument(
        registered=layout.registered,
        rotation=turn(2 * rng.normal(size=(1, 3)))[0] if free else np.eye(3),
        position=rng.uniform(-3, 3, 3) if free else np.zeros(3),
        sigma=layout.sigma,
        sigma_turn=float(rng.uniform(3e-5, 1e-4)) if layout.pose_kind else None,
        joint_sigma=float(np.sqrt(max(floor**2 - layout.sigma**2, 1e-14) / lever)),
    )


@dataclass(frozen=True)
class Laid:
    """Poses and loads of a session, before anything is measured."""

    session: Session
    load: Index
    pose: Index
    held_out: NDArray[np.bool_]


def lay_out(kind: ArmKind, layout: Layout, rng: Generator) -> Laid:
    """Return random poses, each under every load, some twice, and others to hold out."""
    base = rng.uniform(kind.low, kind.high, (layout.poses, kind.n))
    count = layout.poses * len(LOADS)
    again = rng.choice(count, layout.repeated, replace=False)
    pose = np.tile(np.arange(layout.poses), len(LOADS))
    load = np.repeat(np.arange(len(LOADS)), layout.poses)
    pose, load = np.concatenate([pose, pose[again]]), np.concatenate([load, load[again]])
    away = rng.uniform(kind.low, kind.high, (layout.held_out, kind.n))
    q = np.vstack([base[pose], away])
    pose = np.concatenate([pose, layout.poses + np.arange(layout.held_out)])
    load = np.concatenate([load, rng.integers(0, len(LOADS), layout.held_out)])
    lever = 0.35 * kind.tool
    cogs = np.column_stack([rng.uniform(-0.4, 0.4, (len(LOADS), 2)),
                            rng.uniform(0.3, 1.2, len(LOADS))]) * lever  # fmt: skip
    mass = kind.rated * np.array(LOADS)
    session = replace(session_at(q, mass[load]), payload_cog=cogs[load])
    held_out = np.arange(len(q)) >= len(q) - layout.held_out
    return Laid(session, load.astype(np.int64), pose.astype(np.int64), held_out)


def readings_of(
    real: RealArm, laid: Laid, instrument: Instrument, rng: Generator | None
) -> Readings:
    """Return what the instrument reads; ``rng`` None: without any noise."""
    session = laid.session
    exact = replace(
        instrument, sigma=0.0, joint_sigma=0.0,
        sigma_turn=None if instrument.sigma_turn is None else 0.0,
    )  # fmt: skip
    how = exact if rng is None else instrument
    position, rotation = read_arm(real, session, how, rng or np.random.default_rng(0))
    value = position if rotation is None else np.hstack([position, rotation])
    count = len(session.q)
    zeros = np.zeros(count, dtype=np.int64)
    return Readings(
        kind="position" if rotation is None else "pose",
        q=session.q, value=value, scatter=np.full(count, np.nan),
        loads=Loads(payload_mass=session.payload_mass, payload_cog=session.payload_cog),
        load=laid.load, station=zeros, target=zeros, held_out=laid.held_out, pose=laid.pose,
    )  # fmt: skip
