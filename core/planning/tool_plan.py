"""Plan a tool session: orientations in which the tip touches a fixed point."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.tool_session import touch_columns
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.errors import ExcitationError
from gapbridge.core.model import Model
from gapbridge.core.planning.payload_plan import LIMIT_MARGIN, select_d_optimal
from gapbridge.core.planning.travel import ordered_poses
from gapbridge.core.rotation import rotation_matrix, rotation_vector

CANDIDATES = 80
MAX_TILT = 1.0  # rad, of the tool relative to its initial orientation
REACHED = 1e-6  # m and rad, at which a pose counts as reached
TYPICAL_NOISE = 2e-4  # m, 1 sigma of one coordinate of a tip brought onto a point by eye
ROUNDS = 40
STEP = 0.2  # rad, largest change of a joint in one step


@dataclass(frozen=True)
class ToolPlan:
    """The poses of a session, in the order of travel; the first is where it begins."""

    poses: tuple[Array, ...]  # (n,) rad each, tip (as the cell knows it) on the fixed point
    bought: tuple[tuple[int, float], ...]  # touches, expected 1 sigma of the tip (m, 3D)


def plan_tool(
    model: Model, begin: Array, *, poses: int = 6, noise: float = TYPICAL_NOISE, seed: int = 0
) -> ToolPlan:
    """Return poses that keep the tip where it is at ``begin`` (n,) rad and turn the tool about it.

    Tilted by up to TILT (rad) and turned about its own axis, within the joint limits; chosen so
    that the tip is determined best (D-optimal). ``noise`` is 1 sigma (m) of one coordinate of a
    touch. Raises ExcitationError where the arm reaches no orientations that determine the tip.
    """
    begin = np.asarray(begin, dtype=float)
    candidates = _candidates(model, begin, np.random.default_rng(seed))
    rotation = model.predict(candidates).rotation @ model.chain().tool_rotation.T
    columns = touch_columns(rotation) / noise
    chosen = select_d_optimal(columns * 1e-3, min(poses, len(candidates)), first=0)
    bought = []
    for count in range(3, len(chosen) + 1):
        std = _std(columns[chosen[:count]])
        bought.append((count, float(np.linalg.norm(std))))
    if not bought or not bought[-1][1] < 20 * noise:
        raise ExcitationError(
            "tool session: the arm cannot turn the tool far enough about that point within its "
            "joint limits; expected a point in front of the arm, tool pointing down"
        )
    return ToolPlan(tuple(ordered_poses(candidates[chosen], begin)), tuple(bought))


def _candidates(model: Model, begin: Array, rng: np.random.Generator) -> Array:
    """Return poses that hold the tip in place, ``begin`` first."""
    limits = model.arm.limits
    start = model.predict(begin)
    poses = [begin]
    for _ in range(CANDIDATES):
        axis = rng.normal(size=2)
        tilt = axis / np.linalg.norm(axis) * MAX_TILT * np.sqrt(rng.random())
        spin = rng.uniform(-np.pi / 2, np.pi / 2)
        rotation = rotation_matrix(np.array([*tilt, 0.0])) @ rotation_matrix(np.array([0, 0, spin]))
        q = _reach(model, begin, start.position[0], start.rotation[0] @ rotation)
        if (
            q is not None
            and ((q > limits.lower + LIMIT_MARGIN) & (q < limits.upper - LIMIT_MARGIN)).all()
        ):
            poses.append(q)
    return np.array(poses)


def _reach(model: Model, q: Array, position: Array, rotation: Array) -> Array | None:
    """Return joint angles of a pose, near ``q``; None where Newton's method does not converge."""
    q = q.copy()
    rigid = replace(model, terms=tuple(t for t in model.terms if not CATALOGUE[t.effect].softens))
    for _ in range(ROUNDS):
        pose = rigid.predict(q)
        error = np.concatenate(
            [position - pose.position[0], rotation_vector(rotation @ pose.rotation[0].T)]
        )
        if np.abs(error).max() < REACHED:
            return q
        J = rigid.linear_form(q).jacobian[0]
        damping = 1e-4 * float(np.trace(J @ J.T)) * min(1.0, float(np.abs(error).max()))
        step = J.T @ np.linalg.solve(J @ J.T + damping * np.eye(6), error)
        q = q + step * min(1.0, STEP / max(float(np.abs(step).max()), 1e-12))
    return None


def _std(columns: Array) -> Array:
    flat = columns.reshape(-1, 6)
    return np.asarray(np.sqrt(np.diag(np.linalg.pinv(flat.T @ flat, hermitian=True))[:3]))
