"""The poses that the demo measures: the most informative for the fit, others for the check."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.kernels.single import LEVER
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.planning.travel import ordered_poses

CANDIDATES = 400


@dataclass(frozen=True)
class Workspace:
    """Limits of the poses that are drawn."""

    lower: tuple[float, ...]  # rad
    upper: tuple[float, ...]  # rad
    lowest: float  # m, least height of the TCP above the base
    nearest: float  # m, least distance of the TCP from the axis of the base
    far: float  # m, least such distance of a test pose, where arms deflect most
    regular: float  # smallest singular value of the Jacobian (rotations times the lever)


@dataclass(frozen=True)
class Load:
    """A payload on the flange and an external wrench at the TCP."""

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
class Experiment:
    """Workspace, loads and numbers of poses of the demo on one arm."""

    workspace: Workspace
    calibration_loads: tuple[Load, ...]
    test_loads: tuple[Load, ...]
    calibration_poses: int = 10  # per calibration load
    test_poses: int = 3  # per test load
    # per pose, for each test load; the scatter between visits is the arm's repeatability
    visits: tuple[int, ...] = (2, 1)


UR10E = Experiment(
    # around elbow-up poses with the tool pointing down
    Workspace(
        lower=(-0.5, -2.1, 0.8, -2.6, -2.1, -0.7), upper=(0.5, -0.9, 2.1, -0.9, -1.0, 0.7),
        lowest=0.15, nearest=0.35, far=0.6, regular=0.05,
    ),
    CALIBRATION_LOADS,
    TEST_LOADS,
)  # fmt: skip


def candidates(model: Model, seed: int, workspace: Workspace = UR10E.workspace) -> Array:
    """Return poses (N, n) in the workspace and away from singularities, drawn from the seed."""
    bounds = np.array(workspace.lower), np.array(workspace.upper)
    q = np.random.default_rng((seed, 11)).uniform(*bounds, (CANDIDATES, model.arm.n))
    position = model.rigid_pose(q).position
    jacobian = model.without_terms().linear_form(q).jacobian.copy()
    jacobian[:, 3:] *= LEVER
    smallest = np.linalg.svd(jacobian, compute_uv=False)[:, -1]
    radius = np.hypot(position[:, 0], position[:, 1])
    free = (position[:, 2] > workspace.lowest) & (radius > workspace.nearest)
    return q[free & (smallest > workspace.regular)]


def informative(model: Model, q: Array, load: Load, count: int, information: Array) -> Array:
    """Return the indices of ``count`` poses chosen by greedy D-optimal design.

    ``information`` (2n, 2n), in units of one measured position, is updated in place.
    """
    rigid = model.without_terms()
    form = rigid.linear_form(q, load.rows(len(q))).regressor[:, :3] * 1e-5 / 2e-5
    parts = np.einsum("rki,rkj->rij", form, form)
    chosen: list[int] = []
    for _ in range(count):
        gain = np.linalg.slogdet(information + parts)[1]
        gain[chosen] = -np.inf
        best = int(np.argmax(gain))
        chosen.append(best)
        information += parts[best]
    return np.array(chosen)


@dataclass(frozen=True)
class Plan:
    """Poses of the whole demo, in the order of the visits."""

    calibration: tuple[Array, ...]  # per calibration load (N, 6)
    test: tuple[Array, ...]  # visits per test load (M, 6), none at a calibration pose


def plan(model: Model, home: Array, seed: int, experiment: Experiment = UR10E) -> Plan:
    """Return informative poses per calibration load and random ones per test load."""
    free = candidates(model, seed, experiment.workspace)
    n = model.arm.n
    information = np.eye(2 * n) * 1e-2
    used: set[int] = set()
    calibration = []
    for load in experiment.calibration_loads:
        chosen = informative(model, free, load, experiment.calibration_poses, information)
        used |= set(chosen.tolist())
        calibration.append(ordered_poses(free[chosen], home))
    position = model.rigid_pose(free).position
    far = np.flatnonzero(np.hypot(position[:, 0], position[:, 1]) > experiment.workspace.far)
    unused = free[[i for i in far if i not in used]]
    tests = []
    for k in range(len(experiment.test_loads)):
        chosen_poses = unused[k * experiment.test_poses : (k + 1) * experiment.test_poses]
        tests.append(np.tile(ordered_poses(chosen_poses, home), (experiment.visits[k], 1)))
    return Plan(tuple(calibration), tuple(tests))
