"""The benchmark's arms as drawings for both sides: the truth's and the product's."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.blind.arms import ArmKind
from benchmarks.blind.mechanics import Array, RealArm, Session
from gapbridge.core.arm import arm_from_dh
from gapbridge.core.model import Model
from gapbridge.core.rotation import transform


def real_arm(kind: ArmKind, **other: Any) -> RealArm:
    """Return an arm of a class as drawn, rigid, a tool straight out; ``other`` differs."""
    given: dict[str, Any] = {
        "rows": kind.rows,
        "tool_position": np.array([0.0, 0.0, kind.tool]),
        "tool_rotation": np.eye(3),
        "axial": np.zeros(kind.n),
        "radial": np.zeros(kind.n),
        "gravity": np.array([0.0, 0.0, -9.80665]),
    }
    return RealArm(**(given | other))


def model_of(real: RealArm) -> Model:
    """Return the product's model of a drawing: rows, masses, tool, gravity, softness of joints."""
    rows = [
        {"a": r.a, "alpha": r.alpha, "d": r.d, "offset": r.offset, "mass": r.mass, "cog": r.cog}
        for r in real.rows
    ]
    model = Model(
        arm_from_dh(rows),
        transform(real.tool_rotation, real.tool_position),
        gravity=real.gravity.copy(),
        reference_temperature=real.reference_temperature,
    )
    return model.with_compliance(real.axial, real.radial)


def session_at(
    q: Array, mass: Array | float = 0.0, cog: Array | None = None, approach: Array | None = None
) -> Session:
    """Return a session at poses (N, n) under payloads: calm, at the reference temperature."""
    count, n = q.shape
    signs = np.ones((count, n)) if approach is None else approach
    return Session(
        time=30.0 * np.arange(count, dtype=np.float64),
        q=q,
        payload_mass=np.broadcast_to(np.asarray(mass, dtype=float), (count,)).copy(),
        payload_cog=np.broadcast_to(np.zeros(3) if cog is None else cog, (count, 3)).copy(),
        tcp_wrench=np.zeros((count, 6)),
        temperature=np.full((count, n), 25.0),
        approach=signs,
        from_where=q - 0.05 * signs,
    )
