"""Unknown remainders beside known effects: what real arms have, and no catalogue holds.

Written from the physics, with shapes that no effect of the catalogue has. ``akin`` names what a
diagnosis may accuse with the rest admitted (the remainder's first order); ``near`` also the places
where no known effect can be distinguished from it, so that a mixed case puts none there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from benchmarks.blind import outside
from benchmarks.blind.bench import Bench
from benchmarks.blind.measuring import axial_moments
from benchmarks.blind.mechanics import Array, RealArm, Session
from benchmarks.blind.outside import Outside, angle_of

Place = tuple[str, int | None]
SHAPES = ("joint_offset", "transmission_error", "stiffness_nonlinearity", "axial_compliance",
          "backlash")  # fmt: skip


def load_play(bench: Bench, rng: Generator) -> Outside:
    """Return play that opens with the load a joint carries."""
    j = _loaded_joint(bench, rng)
    usual = float(np.quantile(np.abs(axial_moments(bench.nominal, bench.session)[:, j]), 0.8))

    def shape(s: Session) -> Array:
        moment = np.abs(axial_moments(bench.nominal, s)[:, j]) / max(usual, 1e-9)
        return np.asarray(-0.5 * s.approach[:, j] * moment**1.5)

    columns = (f"approach_{j}", *_moment_columns(bench, j))
    made = Outside("load_play", columns, angle_of(j, shape))
    return _reported(made, j, ("backlash",))


def pose_stiffness(bench: Bench, rng: Generator) -> Outside:
    """Return a joint whose gear is softer on one side of its turn."""
    j = _loaded_joint(bench, rng)
    start = rng.uniform(-np.pi, np.pi)

    def shape(s: Session) -> Array:
        moment = axial_moments(bench.nominal, s)[:, j]
        return np.asarray(moment / (1 + np.exp(-3 * np.sin(s.q[:, j] - start))))

    columns = (f"actual_q_{j}", *_moment_columns(bench, j))
    made = Outside("pose_stiffness", columns, angle_of(j, shape), first=1e-6)
    return _reported(made, j, ("axial_compliance",))


def smooth_field(bench: Bench, rng: Generator) -> Outside:
    """Return an angle error that is a random smooth function of two joints."""
    n = bench.kind.n
    j = int(rng.integers(1, n - 1))
    k = int(rng.choice([i for i in range(n - 1) if i != j]))
    rate = rng.normal(size=(6, 2)) * 1.3
    phase, weight = rng.uniform(-np.pi, np.pi, 6), rng.normal(size=6)

    def shape(s: Session) -> Array:
        return np.asarray(np.cos(s.q[:, [j, k]] @ rate.T + phase) @ weight)

    made = Outside("smooth_field", (f"actual_q_{j}", f"actual_q_{k}"), angle_of(j, shape))
    return _reported(made, j, ("joint_offset",))


def bent_tool(bench: Bench, rng: Generator) -> Outside:
    """Return a slender tool that hangs down beyond proportion as gravity goes across it."""
    way = rng.normal(size=(3, 3)) * [1.0, 1.0, 0.2]

    def change(arm: RealArm, strength: float) -> RealArm:
        def shift(s: Session, down: Array) -> Array:
            across = down / 9.80665
            return strength * (across + 0.8 * across * np.abs(across)) @ way.T

        return replace(arm, tool_shifts=(*arm.tool_shifts, shift))

    columns = tuple(f"actual_q_{i}" for i in range(1, bench.kind.n))
    made = Outside("bent_tool", columns, change)
    return replace(made, akin=(("tool_frame", None),), near=(("tool_frame", None),))


def _bump(bench: Bench, rng: Generator) -> Outside:
    made = outside.chipped_tooth(bench, rng)
    return _reported(made, _joint_of(made), ())


def _kink(bench: Bench, rng: Generator) -> Outside:
    made = outside.encoder_scale(bench, rng)
    return _reported(made, _joint_of(made), ("joint_offset",))


def _warm_base(bench: Bench, rng: Generator) -> Outside:
    return replace(outside.tower_bending(bench, rng), near=(("thermal_drift", None),))


def _loose_tool(bench: Bench, rng: Generator) -> Outside:
    place = (("tool_frame", None),)
    return replace(outside.loose_tool(bench, rng), akin=place, near=place)


def _tool_plate(bench: Bench, rng: Generator) -> Outside:
    place = (("tool_frame", None),)
    return replace(outside.tool_plate(bench, rng), akin=place, near=place)


def _joint_of(made: Outside) -> int:
    return int(made.depends_on[0].rpartition("_")[2])


def _reported(made: Outside, joint: int, akin: tuple[str, ...]) -> Outside:
    """Return a remainder in the angle of one joint (from 0) with its kin and its neighbourhood."""
    return replace(
        made,
        akin=tuple((e, joint + 1) for e in akin),
        near=tuple((e, joint + 1) for e in SHAPES),
    )


def _loaded_joint(bench: Bench, rng: Generator) -> int:
    """Return a joint (from 0) that carries much of what the arm carries."""
    size = np.sqrt(np.mean(axial_moments(bench.nominal, bench.session) ** 2, axis=0))
    able = [i for i in range(1, bench.kind.n - 1) if size[i] > 0.15 * size.max()]
    return int(rng.choice(able))


def _moment_columns(bench: Bench, j: int) -> tuple[str, ...]:
    """Return the columns that a joint's moment goes by: the load, and the joints before it."""
    last = min(j + 2, bench.kind.n)
    return ("payload", *(f"actual_q_{i}" for i in range(1, last)))


REMAINDERS = {
    "bump": _bump, "kink": _kink, "load_play": load_play, "pose_stiffness": pose_stiffness,
    "smooth_field": smooth_field, "bent_tool": bent_tool, "warm_base": _warm_base,
    "loose_tool": _loose_tool, "tool_plate": _tool_plate,
}  # fmt: skip
ALONE = ("load_play", "pose_stiffness", "smooth_field", "bent_tool")  # the others stand in outside
