"""Plan a payload session with a flange sensor: how many orientations, and which."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.payload_session import NAMES, weight_columns
from gapbridge.core.errors import ExcitationError
from gapbridge.core.model import Model
from gapbridge.core.planning.travel import ordered_poses
from gapbridge.core.workspace.workspace import Workspace

WRIST_JOINTS = 3  # last joints, which turn the flange with little motion of the arm
CANDIDATES = 600
LIMIT_MARGIN = 0.05  # rad, kept to every joint limit
TYPICAL_NOISE = (0.3, 0.02)  # N, Nm, 1 sigma of an averaged reading of a flange sensor
TARGET_STD = {
    "payload_mass": 0.02,
    "payload_cog_x": 2e-3,
    "payload_cog_y": 2e-3,
    "payload_cog_z": 2e-3,
}
MIN_POSES, MAX_POSES = 6, 20


@dataclass(frozen=True)
class PayloadPlan:
    """The poses of a session with the flange sensor, in the order of travel."""

    poses: tuple[Array, ...]  # (n,) rad each
    std: Array  # (10,) expected 1 sigma of each of payload_session.NAMES


def plan_payload(
    model: Model,
    begin: Array,
    *,
    poses: int | None = None,
    noise: tuple[float, float] = TYPICAL_NOISE,
    seed: int = 0,
    workspace: Workspace | None = None,
) -> PayloadPlan:
    """Return poses around ``begin`` (n,) rad that separate load and sensor bias best (D-optimal).

    Only the last three joints move, within their limits and those of the ``workspace``, whose
    obstacles the arm does not hit (except what it hits by its coarse shape at ``begin``). The
    expected payload is the model's; ``noise`` is 1 sigma of one axis of an averaged reading (N,
    Nm). With ``poses`` None, the number is the smallest (6 to 20) that determines mass to 20 g and
    the centre of gravity to 2 mm. Raises ExcitationError where limits and obstacles leave no
    orientations that separate load from bias.
    """
    begin = np.asarray(begin, dtype=float)
    candidates = _candidates(model, begin, np.random.default_rng(seed), workspace)
    sigma = np.repeat(noise, 3)
    columns = weight_columns(model, candidates) / sigma[None, :, None]
    # the centre of gravity itself, at about this mass
    columns[:, :, 1:4] *= max(model.payload_mass, 0.5)
    scale = np.array([1.0, *[0.1] * 3, *[noise[0]] * 3, *[noise[1]] * 3])
    chosen = select_d_optimal(columns * scale, MAX_POSES if poses is None else poses)
    std = np.full(10, np.inf)
    for count in range(MIN_POSES if poses is None else min(poses, 4), len(chosen) + 1):
        std = _std(columns[chosen[:count]])
        enough = all(std[NAMES.index(name)] <= target for name, target in TARGET_STD.items())
        if poses is None and enough:
            chosen = chosen[:count]
            break
    if not np.isfinite(std).all():
        raise ExcitationError(
            "payload session: within the joint limits and obstacles the wrist cannot turn the "
            "flange far enough to separate load from sensor bias; begin elsewhere"
        )
    return PayloadPlan(tuple(ordered_poses(candidates[chosen], begin)), std)


def _candidates(
    model: Model, begin: Array, rng: np.random.Generator, workspace: Workspace | None
) -> Array:
    n = model.arm.n
    free = np.arange(max(n - WRIST_JOINTS, 0), n)
    limits = model.arm.limits if workspace is None else workspace
    # a joint that hardly turns, or not within half a turn of zero, stays at an allowed angle
    margin = np.minimum(LIMIT_MARGIN, (limits.upper - limits.lower) / 2)
    lower, upper = limits.lower + margin, limits.upper - margin
    low, high = np.clip(-np.pi, lower, upper), np.clip(np.pi, lower, upper)
    candidates = np.tile(begin, (CANDIDATES, 1))
    candidates[1:, free] = rng.uniform(low[free], high[free], (CANDIDATES - 1, len(free)))
    if workspace is None:
        return candidates
    hits = np.array(list(workspace.rejections(candidates).values()))
    hits &= ~hits[:, :1]
    return candidates[~hits.any(axis=0)]


def select_d_optimal(columns: Array, count: int, first: int | None = None) -> list[int]:
    """Return ``count`` candidates by greedy D-optimal selection.

    ``columns`` (C, k, p) are the readings' derivatives over their noise; ``first`` is kept.
    """
    information = 1e-6 * np.eye(columns.shape[2])
    chosen: list[int] = []
    for _ in range(min(count, len(columns))):
        root = np.linalg.inv(information)
        inner = np.einsum("cip,pq,cjq->cij", columns, root, columns)
        gain = np.linalg.slogdet(np.eye(columns.shape[1]) + inner)[1]
        gain[chosen] = -np.inf
        best = first if first is not None and not chosen else int(np.argmax(gain))
        chosen.append(best)
        information = information + columns[best].T @ columns[best]
    return chosen


def _std(columns: Array) -> Array:
    flat = columns.reshape(-1, columns.shape[2])
    values, vectors = np.linalg.eigh(flat.T @ flat)
    if values[0] <= 1e-9 * values[-1]:
        return np.full(len(values), np.inf)
    return np.asarray(np.sqrt(np.einsum("ik,ik->i", vectors / values, vectors)))
