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
    turn, point = Rotation.identity(), np.zeros(3)
    origins, turns, centres = [], [], []
    for row, q, bend in zip(case.dh, case.q, bends, strict=True):
        origins.append(point)
        # the row's offset is part of the joint's own turn
        joint = Rotation.from_euler("z", q + row.get("offset", 0.0))
        link = turn * joint * Rotation.from_rotvec(bend)
        turns.append(link)
        point = point + link.apply([row["a"], 0.0, row["d"]])
        turn = link * Rotation.from_euler("x", row["alpha"])
        centres.append(point + turn.apply(row.get("cog", np.zeros(3))))
    return origins, turns, centres, (turn, point), point + turn.apply(case.tool_position)


def residual(case: Case, flat: np.ndarray) -> np.ndarray:
    """Return bend minus compliance times moment, (3n,) rad."""
    bends = flat.reshape(-1, 3)
    origins, turns, centres, (flange, point), tcp = place(case, bends)
    load_at = point + flange.apply(case.payload_cog)
    out = np.empty_like(bends)
    for i, origin in enumerate(origins):
        moment = case.wrench[3:] + np.cross(tcp - origin, case.wrench[:3])
        moment = moment + np.cross(load_at - origin, case.payload * case.gravity)
        for centre, row in zip(centres[i:], case.dh[i:], strict=True):
            moment = moment + np.cross(centre - origin, row.get("mass", 0.0) * case.gravity)
        local = turns[i].inv().apply(moment)
        out[i] = bends[i] - np.array([case.radial[i], case.radial[i], case.axial[i]]) * local
    return out.ravel()


def solve(case: Case) -> tuple[np.ndarray, np.ndarray]:
    """Return TCP position (3,) and rotation (3, 3) of the bent arm."""
    start = np.zeros(3 * len(case.dh))
    found = root(lambda x: 1e3 * residual(case, x), start, method="hybr", options={"xtol": 1e-13})
    assert np.abs(residual(case, found.x)).max() < 1e-11, found.message
    _, _, _, (flange, _), tcp = place(case, found.x.reshape(-1, 3))
    return tcp, (flange * case.tool_rotation).as_matrix()


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
