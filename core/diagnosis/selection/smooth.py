"""Smooth candidates: unnamed functions of one quantity, which compete with the catalogue.

If one is selected, the result is ``unexplained``, with the quantity. Each moves one target: a
joint's angle, the measurement in base axes, the tool in flange axes, or the scale of the arm.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.observation import HELD_TORQUE, Observation
from gapbridge.core.diagnosis.selection.candidate import Candidate, joint_target, target_of
from gapbridge.core.effects import Parameter, Site

CandidateColumns = tuple[Candidate, Array]
KNOTS = 5
BUMPS = 24  # centres of local bumps over a joint's range
CHANGES_FRICTION = ("timestamp", "payload")
SLOW = (0.03, 0.1, 0.3)  # shares of the largest speed over which friction may decay (Stribeck)
STEPS = 23  # times of a possible jump


def smooth_candidates(observation: Observation) -> list[CandidateColumns]:
    """Return the smooth candidates of an observation with their columns (N, k, d)."""
    pairs: list[CandidateColumns] = []
    moved = targets(observation)
    for name, z in observation.quantities.items():
        shapes = [linear_basis(z)]
        if len(np.unique(z)) > 2:
            shapes.append(spline_basis(z))
        for target, directions in moved.items():
            own = target == target_of(name, "actual_q", "target_q")
            holds = target == target_of(name, HELD_TORQUE)
            for shape in shapes:
                full = np.hstack([np.ones((len(z), 1)), shape]) if own or holds else shape
                pairs.append(_spread(name, target, directions, full))
            if own:
                pairs += _bumps(name, target, z, directions)
        if name == "timestamp":
            pairs += _steps(name, z, moved)
        pairs += _frictions(name, z, observation)
    pairs += _springs(observation)
    for target, columns in observation.unnamed():
        pairs.append(unnamed("", target, columns))
    return pairs


def _springs(observation: Observation) -> list[CandidateColumns]:
    """Return joint deflections as a function of the joint's own moment."""
    J, moment = observation.joint_columns, observation.axial_moment
    if J is None or moment is None:
        return []
    return [
        _spread("", f"moment_{j + 1}", J[:, :, j : j + 1], spline_basis(moment[:, j]))
        for j in range(moment.shape[1])
        if np.ptp(moment[:, j]) > 1e-9 * max(float(np.abs(moment).max()), 1e-300)
    ]


def _frictions(name: str, z: Array, observation: Observation) -> list[CandidateColumns]:
    """Return friction that depends on time, load, or the joint's own temperature or speed."""
    if observation.friction is None:
        return []
    pairs = []
    for j in range(observation.friction.shape[1]):
        shapes, joint = [], joint_target(j + 1)
        if name in CHANGES_FRICTION or target_of(name, "joint_temperatures") == joint:
            shapes = [linear_basis(z)]
        elif target_of(name, "actual_qd") == joint:
            slow = np.abs(z) / max(float(np.abs(z).max()), 1e-300)
            shapes = [np.exp(-slow / share)[:, None] for share in SLOW]
        columns = np.zeros((*observation.friction.shape, 1))
        columns[:, j, 0] = observation.friction[:, j]
        pairs += [_spread(name, f"friction_{j + 1}", columns, shape) for shape in shapes]
    return pairs


def targets(observation: Observation) -> dict[str, Array]:
    """Return the targets: name -> directions (N, k, directions) in which they can move."""
    N, k = observation.measured.shape
    J = observation.joint_columns
    if J is None:
        return {axis: np.tile(np.eye(k)[:, i : i + 1], (N, 1, 1))
                for i, axis in enumerate(observation.axes)}  # fmt: skip
    directions = {joint_target(i + 1): J[:, :, i : i + 1] for i in range(J.shape[2])}
    if observation.channel != "position":  # coordinates are joints
        return directions
    shift = np.zeros((N, k, 3))
    shift[:, :3] = np.eye(3)
    directions["position"] = shift
    scale = np.zeros((N, k, 1))
    scale[:, :3, 0] = observation.measured[:, :3]
    directions["scale"] = scale
    if observation.tool_axes is not None:
        tool = np.zeros((N, k, 3))
        tool[:, :3] = observation.tool_axes
        directions["tool"] = tool
    return directions


def _spread(quantity: str, target: str, directions: Array, shape: Array) -> CandidateColumns:
    columns = directions[:, :, :, None] * shape[:, None, None, :]
    return unnamed(quantity, target, columns.reshape(*columns.shape[:2], -1))


def unnamed(quantity: str, target: str, columns: Array) -> CandidateColumns:
    """Return a smooth candidate with its columns (N, k, d)."""
    size = columns.shape[-1]
    scale = (Parameter("", "", 1e-3),) * size
    smooth = Candidate("smooth", Site(), scale, (None,) * size, quantity=quantity, target=target)
    return smooth, columns


def _bumps(name: str, target: str, z: Array, directions: Array) -> list[CandidateColumns]:
    pairs = []
    low, high = float(z.min()), float(z.max())
    for width in ((high - low) / BUMPS, (high - low) / (2.5 * BUMPS), 2.4 * (high - low) / BUMPS):
        for centre in np.arange(low, high, width):
            bump = np.exp(-0.5 * ((z - centre) / width) ** 2)
            if (bump > 0.3).sum() >= 2:
                pairs.append(_spread(name, target, directions, bump[:, None]))
    return pairs


def _steps(name: str, z: Array, targets: dict[str, Array]) -> list[CandidateColumns]:
    pairs = []
    for quantile in np.linspace(0.06, 0.94, STEPS):
        after = (z > np.quantile(z, quantile)).astype(float)[:, None]
        if 2 <= after.sum() <= len(z) - 2:
            steps = (_spread(name, target, d, after) for target, d in targets.items())
            pairs += [(replace(step, jumps=True), columns) for step, columns in steps]
    return pairs


def linear_basis(z: Array) -> Array:
    """Return the quantity itself, centred and of unit size (N, 1)."""
    return np.asarray(((z - z.mean()) / max(float(np.std(z)), 1e-300))[:, None])


def spline_basis(z: Array) -> Array:
    """Return a smooth basis (N, <= KNOTS - 1) over the quantity's ranks and range, centred.

    Few distinct values give one indicator each; otherwise natural cubics (truncated powers).
    """
    levels = np.unique(np.round(z / max(np.ptp(z), 1e-300), 6))
    unit = (z - z.min()) / np.ptp(z)
    if len(levels) <= KNOTS:
        values = np.round(z / np.ptp(z), 6)
        basis = np.stack([(values == level).astype(float) for level in levels[1:]], axis=1)
    else:
        knots = np.linspace(0, 1, KNOTS)[1:-1]
        powers = [unit, unit**2, *(np.clip(unit - t, 0, None) ** 3 for t in knots[:2])]
        basis = np.stack(powers, axis=1)
    return np.asarray(basis - basis.mean(axis=0))
