"""Arms that nobody builds: lengths, masses and softness drawn about a few ways to set axes."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from benchmarks.blind.arms import ArmKind
from benchmarks.blind.mechanics import Row

H = np.pi / 2
# twists of consecutive axes; the second and third rows of 6-joint arms are the long links
TWISTS = (
    (H, 0, 0, H, -H, 0),
    (-H, 0, -H, H, -H, 0),
    (-H, 0, H, -H, H, 0),
    (H, 0, H, -H, H, 0),
    (-H, H, H, -H, -H, H, 0),
    (-H, H, -H, H, -H, H, 0),
)
GRAVITY = 9.80665


def draw_arm(rng: Generator) -> ArmKind:
    """Return a random arm of 6 or 7 joints that reaches 0.5 to 3 m."""
    twists = TWISTS[int(rng.integers(len(TWISTS)))]
    n, reach = len(twists), float(np.exp(rng.uniform(np.log(0.5), np.log(3.0))))
    length = reach * _shares(n, rng)
    rows = []
    strong = float(rng.uniform(4, 9)) * reach**1.5  # kg/m of the first links
    for i, twist in enumerate(twists):
        along_x = n == 6 and i in (1, 2) and twist in (0, H, -H)
        a = round(float(length[i]), 4) * (1 if rng.random() < 0.5 else -1) if along_x else 0.0
        d = 0.0 if along_x else round(float(length[i]), 4)
        if rng.random() < 0.3:  # a shoulder or wrist set off
            a += round(float(rng.uniform(-0.08, 0.08)) * reach, 4)
        thin = (1 - i / n) ** 1.5 + 0.05
        mass = round(strong * thin * (abs(a) + abs(d) + 0.1 * reach), 3)
        middle = (-0.5 * a, 0.0, -0.5 * d) if abs(twist) < 1e-9 else (-0.5 * a, -0.4 * d, 0.0)
        cog = tuple(round(float(x + rng.normal() * 0.02 * reach), 4) for x in middle)
        rows.append(Row(a, twist, d, 0.0, mass, (cog[0], cog[1], cog[2])))
    rated = round(float(reach**1.7 * rng.uniform(4, 12)), 1)
    moment = rated * GRAVITY * reach + sum(r.mass for r in rows) * GRAVITY * reach * 0.3
    decay = np.exp(np.linspace(0, 1.8, n))
    axial = 1.5e-3 / moment * decay * rng.uniform(0.7, 1.4, n)
    radial = 0.4e-3 / moment * decay * rng.uniform(0.7, 1.4, n)
    wide = rng.uniform(1.7, 2.9, n)
    return ArmKind(
        "random",
        tuple(rows),
        tuple(float(-x) for x in wide),
        tuple(float(x) for x in wide),
        rated,
        round(rated * 5.5, 1),
        tuple(float(x) for x in axial),
        tuple(float(x) for x in radial),
        round(0.12 * reach, 3),
        as_urdf=bool(rng.random() < 0.3),
    )


def _shares(n: int, rng: Generator) -> np.ndarray:
    """Return how the reach is shared out over the links (n,)."""
    usual = [0.14, 0.42, 0.38, 0.13, 0.08, 0.08] if n == 6 else [
        0.25, 0.0, 0.3, 0.0, 0.3, 0.0, 0.1]  # fmt: skip
    return np.array(usual) * rng.uniform(0.7, 1.3, n)
