"""Random arms in random cells: built-in ones and drawings, tools, loads, trackers, obstacles."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import Arm, JointLimits, arm_from_dh, builtin_arm
from gapbridge.core.calibration.plan import Payload
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix
from gapbridge.core.workspace.capsules import Box
from gapbridge.core.workspace.workspace import Place, Reflector, Workspace

Array = NDArray[np.float64]
BUILTIN = ("ur3e", "ur5e", "ur10e", "ur16e", "ur20", "ur30")
H = np.pi / 2


@dataclass(frozen=True)
class RandomCell:
    """An arm with its tool, loads and the room around it."""

    name: str
    model: Model
    loads: tuple[Payload, ...]
    space: Workspace


def random_cell(seed: int) -> RandomCell:
    """Return a cell of its own for every seed."""
    random = np.random.default_rng(seed)
    arm = _drawn(random) if seed % 2 else builtin_arm(BUILTIN[seed // 2 % len(BUILTIN)])
    tool = np.eye(4)
    tool[:3, :3] = rotation_matrix(random.normal(0, 0.2, 3))
    tool[:3, 3] = [*random.normal(0, 0.04, 2), random.uniform(0.08, 0.25)]
    model = Model(arm, tool)
    return RandomCell(f"{arm.name}-{seed}", model, _loads(arm, random), _room(model, random))


def _loads(arm: Arm, random: np.random.Generator) -> tuple[Payload, ...]:
    """Return one to three weights that happen to be there, and no load at all."""
    loads = [Payload(0.0)]
    for _ in range(int(random.integers(1, 4))):
        mass = float(random.uniform(0.1, 0.9) * arm.payload)
        cog = tuple(float(c) for c in (*random.normal(0, 0.03, 2), random.uniform(0.03, 0.12)))
        loads.append(Payload(mass, (cog[0], cog[1], cog[2])))
    return tuple(loads)


def _room(model: Model, random: np.random.Generator) -> Workspace:
    """Return a floor, a box and a tracker that sees a reflector within a cone."""
    long = model.length
    angle, far = random.uniform(-np.pi, np.pi), random.uniform(1.5, 3.0) * long
    place = (far * np.cos(angle), far * np.sin(angle), random.uniform(0.2, 1.0) * long)
    middle = random.uniform(-np.pi, np.pi)
    at = np.array([np.cos(middle), np.sin(middle)]) * 0.7 * long
    size = 0.15 * long
    box = Box((at[0] - size, at[1] - size, -1.0), (at[0] + size, at[1] + size, 0.2 * long))
    return Workspace.of(
        model, floor=0.0, keep_out=(box,), places=(Place(place, nearest=0.3),),
        reflector=Reflector(
            looks=(0.3, 0.0, 1.0), acceptance=np.radians(random.uniform(30, 80))
        ),
    )  # fmt: skip


def _drawn(random: np.random.Generator) -> Arm:
    """Return an arm of six or seven joints with lengths and weights of its own."""
    scale = random.uniform(0.6, 1.8)
    upper, fore = scale * random.uniform(0.3, 0.5, 2)
    small = scale * random.uniform(0.08, 0.15, 4)
    weight = 20 * scale**2
    seven = random.random() < 0.4
    if seven:
        rows = [(0.0, -H, small[0] * 2), (0, H, 0), (0, H, upper), (0, -H, 0), (0, -H, fore),
                (0, H, 0), (0, 0, small[1])]  # fmt: skip
        share = [0.2, 0.25, 0.15, 0.15, 0.1, 0.1, 0.05]
    else:
        shoulder = float(random.choice([0.0, small[1]]))
        rows = [(shoulder, -H, small[0] * 2), (upper, 0, 0), (small[2] / 3, -H, 0), (0, H, fore),
                (0, -H, 0), (0, 0, small[3])]  # fmt: skip
        share = [0.3, 0.3, 0.2, 0.1, 0.07, 0.03]
    n = len(rows)
    table = [
        {"a": a, "alpha": alpha, "d": d, "mass": weight * part, "cog": [-0.4 * a, 0, -0.3 * d]}
        for (a, alpha, d), part in zip(rows, share, strict=True)
    ]
    wide = np.full(n, 2.8)
    limits = JointLimits(-wide, wide, np.full(n, 2.5), np.full(n, 300.0))
    arm = arm_from_dh(table, f"drawn{n}", limits)
    return replace(arm, payload=6 * scale**2)
