"""Which poses the demo measures: the most informative about the joints, others to check."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.kernels.single import LEVER
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.planning.travel import shortest_order

CANDIDATES = 400


@dataclass(frozen=True)
class Workspace:
    """Where an arm may go."""

    lower: tuple[float, ...]  # rad
    upper: tuple[float, ...]  # rad
    lowest: float  # m: the tool comes no closer to the table
    nearest: float  # m: the tool stays at least this far from the base's axis
    far: float  # m: test poses reach out as far as this, where arms bend
    regular: float  # smallest singular value of the Jacobian (rotations times the lever)


@dataclass(frozen=True)
class Load:
    """What a person hangs on the flange, and what pulls at the tool."""

    name: str
    mass: float  # kg
    cog: tuple[float, float, float] = (0.0, 0.0, 0.06)  # m, flange frame
    wrench: tuple[float, ...] = (0.0,) * 6  # N, Nm, at the TCP, base axes

    def rows(self, count: int) -> Loads:
        """Return this load for ``count`` rows."""
        return Loads(
            payload_mass=np.full(count, self.mass),
            payload_cog=np.tile(self.cog, (count, 1)),
            wrench=np.tile(self.wrench, (count, 1)),
        )


CALIBRATION_LOADS = (
    Load("5 kg", 5.0),
    Load("12 kg", 12.0),
    Load("4 kg and a pull", 4.0, wrench=(40.0, 50.0, -30.0, 0.0, 0.0, 0.0)),
)
TEST_LOADS = (
    Load("12 kg", 12.0, (0.01, 0.0, 0.08)),
    Load("8 kg and a pull", 8.0, wrench=(-20.0, 25.0, -50.0, 0.0, 0.0, 0.0)),
)


@dataclass(frozen=True)
class Scene:
    """What is shown on one arm."""

    workspace: Workspace
    calibration_loads: tuple[Load, ...]
    test_loads: tuple[Load, ...]
    calibrate: int = 10  # poses per calibration load
    test: int = 3  # poses per test load
    # of each pose of each test load: what differs between them is the arm's repeatability
    visits: tuple[int, ...] = (2, 1)


UR10E = Scene(
    # around elbow-up poses with the tool pointing down
    Workspace(
        lower=(-0.5, -2.1, 0.8, -2.6, -2.1, -0.7), upper=(0.5, -0.9, 2.1, -0.9, -1.0, 0.7),
        lowest=0.15, nearest=0.35, far=0.6, regular=0.05,
    ),
    CALIBRATION_LOADS,
    TEST_LOADS,
)  # fmt: skip


def candidates(model: Model, seed: int, workspace: Workspace = UR10E.workspace) -> Array:
    """Return free, regular poses (N, 6) drawn from the seed."""
    bounds = np.array(workspace.lower), np.array(workspace.upper)
    q = np.random.default_rng((seed, 11)).uniform(*bounds, (CANDIDATES, model.arm.n))
    position = model.rigid_pose(q).position
    jacobian = model.without_terms().linear_form(q).jacobian.copy()
    jacobian[:, 3:] *= LEVER
    smallest = np.linalg.svd(jacobian, compute_uv=False)[:, -1]
    away = np.hypot(position[:, 0], position[:, 1])
    free = (position[:, 2] > workspace.lowest) & (away > workspace.nearest)
    return q[free & (smallest > workspace.regular)]


def informative(model: Model, q: Array, load: Load, count: int, known: Array) -> Array:
    """Return the indices of ``count`` poses that add most to what is known (D-optimal, greedy).

    ``known`` (2n, 2n) is the information so far, in units of one measured position; it is updated
    in place.
    """
    rigid = model.without_terms()
    form = rigid.linear_form(q, load.rows(len(q))).regressor[:, :3] * 1e-5 / 2e-5
    parts = np.einsum("rki,rkj->rij", form, form)
    chosen: list[int] = []
    for _ in range(count):
        gain = np.linalg.slogdet(known + parts)[1]
        gain[chosen] = -np.inf
        best = int(np.argmax(gain))
        chosen.append(best)
        known += parts[best]
    return np.array(chosen)


def tour(q: Array, start: Array) -> Array:
    """Return a short way from the start through the poses (N, 6): their order."""
    return np.array(shortest_order(_apart(q, q), _apart(start[None], q)[0]), dtype=int)


def _apart(q: Array, to: Array) -> Array:
    """Return how far the joint that moves most goes from ``q`` (A, n) to ``to`` (B, n): (A, B)."""
    return np.asarray(np.abs(q[:, None] - to[None]).max(axis=2))


@dataclass(frozen=True)
class Plan:
    """Poses of the whole demo, each list in the order of its visits."""

    calibration: tuple[Array, ...]  # per calibration load (N, 6)
    test: tuple[Array, ...]  # visits per test load (M, 6), at no pose of the calibration


def plan(model: Model, home: Array, seed: int, scene: Scene = UR10E) -> Plan:
    """Return informative poses per calibration load and random ones per test load."""
    free = candidates(model, seed, scene.workspace)
    n = model.arm.n
    known = np.eye(2 * n) * 1e-2
    used: set[int] = set()
    calibration = []
    for load in scene.calibration_loads:
        chosen = informative(model, free, load, scene.calibrate, known)
        used |= set(chosen.tolist())
        calibration.append(free[chosen][tour(free[chosen], home)])
    position = model.rigid_pose(free).position
    far = np.flatnonzero(np.hypot(position[:, 0], position[:, 1]) > scene.workspace.far)
    rest = free[[i for i in far if i not in used]]
    tests = []
    for k in range(len(scene.test_loads)):
        chosen_poses = rest[k * scene.test : (k + 1) * scene.test]
        chosen_poses = chosen_poses[tour(chosen_poses, home)]
        tests.append(np.tile(chosen_poses, (scene.visits[k], 1)))
    return Plan(tuple(calibration), tuple(tests))
