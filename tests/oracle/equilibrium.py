"""The bent arm as one system of equations, solved by MINPACK.

Unknowns are the bend vectors of all joints at once; a residual is what one of them differs by from
its compliance times the sum of all single moments about its joint (no recursion from the tip, no
fixed-point iteration). Frames come from standard DH rows through scipy's rotations.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import root
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Case:
    """One arm in one pose under one load."""

    dh: list[dict]  # rows {a, alpha, d, offset, mass, cog}
    q: np.ndarray
    axial: np.ndarray  # rad/Nm
    radial: np.ndarray
    tool_position: np.ndarray
    tool_rotation: Rotation
    payload: float
    payload_cog: np.ndarray
    wrench: np.ndarray  # at the TCP, base axes
    gravity: np.ndarray


def place(case: Case, bends: np.ndarray):
    """Return joint origins, links' rotations, links' centres, flange and TCP."""
    n = len(case.dh)
    # the row's offset is part of the joint's own turn
    angles = case.q + np.array([row.get("offset", 0.0) for row in case.dh])
    joints = Rotation.from_rotvec(angles[:, None] * [0, 0, 1.0]) * Rotation.from_rotvec(bends)
    twists = Rotation.from_rotvec([[row["alpha"], 0, 0] for row in case.dh]).as_matrix()
    joints = joints.as_matrix()
    turn, point = np.eye(3), np.zeros(3)
    origins, turns, centres = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3))
    for i, row in enumerate(case.dh):
        origins[i] = point
        turns[i] = turn @ joints[i]
        point = point + turns[i] @ [row["a"], 0.0, row["d"]]
        turn = turns[i] @ twists[i]
        centres[i] = point + turn @ row.get("cog", np.zeros(3))
    return origins, turns, centres, (turn, point), point + turn @ case.tool_position


def residual(case: Case, flat: np.ndarray) -> np.ndarray:
    """Return bend minus compliance times moment, (3n,) rad."""
    bends = flat.reshape(-1, 3)
    origins, turns, centres, (flange, point), tcp = place(case, bends)
    mass = np.array([row.get("mass", 0.0) for row in case.dh])
    points = np.vstack([centres, point + flange @ case.payload_cog, tcp])
    forces = np.vstack([np.outer([*mass, case.payload], case.gravity), case.wrench[:3]])
    out = np.empty_like(bends)
    for i, origin in enumerate(origins):
        lever = points[i:] - origin
        moment = case.wrench[3:] + np.cross(lever, forces[i:]).sum(axis=0)
        softness = np.array([case.radial[i], case.radial[i], case.axial[i]])
        out[i] = bends[i] - softness * (turns[i].T @ moment)
    return out.ravel()


def solve(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Return TCP position (3,) and rotation (3, 3) of the bent arm."""
    unknowns = 3 * len(case.dh)
    found = root(
        lambda x: 1e3 * residual(case, x), np.zeros(unknowns), method="hybr",
        jac=lambda x: 1e3 * np.eye(unknowns), options={"xtol": 1e-13},
    )  # fmt: skip
    if np.abs(residual(case, found.x)).max() > 1e-12:  # soft arms need the true Jacobian
        found = root(lambda x: 1e3 * residual(case, x), found.x, options={"xtol": 1e-13})
    assert np.abs(residual(case, found.x)).max() < 1e-11, found.message
    _, _, _, (flange, _), tcp = place(case, found.x.reshape(-1, 3))
    return tcp, flange @ case.tool_rotation.as_matrix()


def random_case(rng: np.random.Generator, dh: list[dict], payload: float, softness: float) -> Case:
    """Return a random pose, load and compliance; ``softness`` is a usual flexibility, rad/Nm."""
    n = len(dh)
    return Case(
        dh=dh,
        q=rng.uniform(-np.pi, np.pi, n),
        axial=softness * rng.uniform(0, 2, n),
        radial=softness * rng.uniform(0, 2, n),
        tool_position=rng.uniform(-0.2, 0.2, 3),
        tool_rotation=Rotation.random(random_state=int(rng.integers(1 << 30))),
        payload=float(rng.uniform(0, payload)),
        payload_cog=rng.uniform(-0.1, 0.1, 3),
        wrench=rng.normal(size=6) * np.array([40, 40, 40, 5, 5, 5]),
        gravity=np.array([*rng.uniform(-2, 2, 2), -9.6]),
    )
