"""Unnamed causes that are no function of one quantity: compliances, loads and forces.

They model causes that are not in the catalogue. If one is selected instead of named causes, the
result is ``unexplained``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.dynamics import contributions_of, frames_of
from gapbridge.core.effects.effect import typical_moment
from gapbridge.core.kernels.reference import Chain, Rows, predict_rows
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion
from gapbridge.core.rotation import rotation_vector

MIN_LENGTH = 1e-3  # m: shorter links do not bend
LOAD_OFFSET = 0.1  # m, of a load from the TCP
FORCE_STEP = 1.0  # N, of the central differences


def unnamed_causes(model: Model, q: Array, loads: Loads, k: int) -> tuple[tuple[str, Array], ...]:
    """Return target and columns (N, k, d) of every unnamed cause; ``q`` (N, n) rad, k is 3 or 6.

    Compliance of each joint across its axis in two directions, bending of each link with any
    distribution of stiffness, tilt of the base, and an undeclared force at the tool: downwards, in
    any base direction, in any tool direction.
    """
    return (
        *_joint_compliances(model, q, loads, k),
        *_link_bending(model, q, loads, k),
        *_forces(model, q, loads, k),
    )


def _joint_compliances(model: Model, q: Array, loads: Loads, k: int) -> list[tuple[str, Array]]:
    chain, rows = model.chain(), model.rows(q, loads)
    step = 1e-2 * 1e-3 / typical_moment(model.arm)
    rivals = []
    for i in range(model.arm.n + 1):
        columns = np.zeros((len(q), k, 2))
        for axis in range(2):  # about z: axial_compliance
            ends = []
            for h in (step, -step):
                bent, tilted = chain.compliance.copy(), chain.base_compliance.copy()
                if i == 0:
                    tilted[axis] += h
                else:
                    bent[i - 1, axis] += h
                changed = chain._replace(compliance=bent, base_compliance=tilted)
                ends.append(_poses(changed, rows))
            columns[:, :, axis] = _change(ends, 2 * step, k)
        rivals.append((f"joint_{i}" if i else "base", columns))
    return rivals


def _link_bending(model: Model, q: Array, loads: Loads, k: int) -> list[tuple[str, Array]]:
    """Return three compliant hinges along each link, at its ends and its middle."""
    still = np.zeros_like(q)
    frames = frames_of(model.chain(), q, still, still)
    tip = model.predict(q, loads).position
    form = model.linear_form(q, loads)
    rivals = []
    for i in range(model.arm.n - 1):
        near, far = frames.origin[:, i], frames.origin[:, i + 1]
        along = far - near
        length = np.linalg.norm(along, axis=1, keepdims=True)
        if float(length.min()) < MIN_LENGTH:
            continue
        along = along / length
        hinges = (near, (near + far) / 2, far)
        moments = [form.moment[:, i], form.moment[:, i + 1]]
        moments.insert(1, (moments[0] + moments[1]) / 2)
        columns = np.zeros((len(q), 6, 3))
        for hinge, (place, moment) in enumerate(zip(hinges, moments, strict=True)):
            turn = moment - along * np.sum(along * moment, axis=1, keepdims=True)
            columns[:, :3, hinge] = np.cross(turn, tip - place)
            columns[:, 3:, hinge] = turn
        rivals.append((f"link_{i + 1}", columns[:, :k]))
    return rivals


def _forces(model: Model, q: Array, loads: Loads, k: int) -> list[tuple[str, Array]]:
    if not model.chain().compliance.any():
        return []  # a force does not move a rigid arm
    chain = model.chain()
    tool_axes = model.predict(q, loads).rotation
    declared = np.zeros((len(q), 6)) if loads.wrench is None else loads.wrench
    in_base = np.zeros((len(q), k, 3))
    for axis in range(3):
        ends = []
        for h in (FORCE_STEP, -FORCE_STEP):
            pulled = np.array(np.broadcast_to(declared, (len(q), 6)))
            pulled[:, axis] += h
            ends.append(_poses(chain, model.rows(q, replace(loads, wrench=pulled))))
        in_base[:, :, axis] = _change(ends, 2 * FORCE_STEP, k)
    down = model.gravity / max(float(np.linalg.norm(model.gravity)), 1e-300)
    return [
        ("load", in_base @ down[:, None]),
        ("pull", in_base),
        ("tool pull", in_base @ tool_axes),
    ]


def unnamed_loads(model: Model, motion: Motion, channel: str) -> tuple[tuple[str, Array], ...]:
    """Return the columns of undeclared loads on torques (N, n, d) or wrenches (N, 6, d).

    A mass anywhere at the tool, a force in any base direction and, for torques, in any tool
    direction (for a sensor on the flange that is a bias).
    """
    count, columns = len(motion), []
    for axis in range(3):
        unit = np.zeros((count, 6))
        unit[:, axis] = 1.0
        pulled = replace(motion, loads=replace(motion.loads, wrench=unit))
        pieces = contributions_of(model, pulled)
        columns.append(pieces.external_torque if channel == "torque" else pieces.external_wrench)
    in_base = np.stack(columns, axis=2)
    rivals = [("load", _mass_anywhere(model, motion, channel)), ("pull", in_base)]
    if channel == "torque":
        rivals.append(("tool pull", in_base @ model.rigid_pose(motion.q).rotation))
    return tuple(rivals)


def _mass_anywhere(model: Model, motion: Motion, channel: str) -> Array:
    """Return columns (N, k, 4) of a mass at the TCP and of its offset along each axis."""
    at_tool = model.tool_in_flange[:3, 3]
    columns = []
    for off in (np.zeros(3), *(LOAD_OFFSET * np.eye(3))):
        place = np.tile(at_tool + off, (len(motion), 1))
        pieces = contributions_of(
            model, replace(motion, loads=replace(motion.loads, payload_cog=place))
        )
        columns.append(pieces.payload_torque if channel == "torque" else pieces.payload_wrench)
    columns[1:] = [(c - columns[0]) / LOAD_OFFSET for c in columns[1:]]
    return np.stack(columns, axis=2)


def _poses(chain: Chain, rows: Rows) -> tuple[Array, Array]:
    count = len(rows.q)
    position, rotation = np.empty((count, 3)), np.empty((count, 3, 3))
    predict_rows(chain, rows, position, rotation)
    return position, rotation


def _change(ends: list[tuple[Array, Array]], step: float, k: int) -> Array:
    """Return the change (N, k) of position and rotation vector per unit between two ends."""
    (position, rotation), (before, turned) = ends
    columns = np.empty((len(position), k))
    columns[:, :3] = (position - before) / step
    if k > 3:
        columns[:, 3:] = rotation_vector(rotation @ np.swapaxes(turned, 1, 2)) / step
    return columns
