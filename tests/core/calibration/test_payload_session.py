"""Sessions with the flange sensor: load and bias against truths made by mechanics of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.blind.arms import ARMS
from benchmarks.blind.mechanics import stand
from benchmarks.calibration.drawings import model_of, real_arm, session_at
from gapbridge.core.calibration.payload_session import AXES, calibrate_payload, weight_columns
from gapbridge.core.effects import Site, Term
from gapbridge.core.errors import ExcitationError, InputError
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason
from gapbridge.core.planning.payload_plan import plan_payload
from gapbridge.core.workspace.capsules import Box
from gapbridge.core.workspace.workspace import Workspace

Array = NDArray[np.float64]
KIND = ARMS["cobot10"]
BEGIN = np.array([0.0, -1.5, 1.5, -1.5, -1.5, 0.0])
FORCE, TORQUE = 0.1, 0.005  # N, Nm


def _readings(
    q: Array, rng: np.random.Generator, gravity: tuple[float, ...] = (0.0, 0.0, -9.80665)
) -> tuple[Array, Array]:
    """Return what a sensor reads (N, 6), and the truth (10,): mass, cog, bias."""
    mass, cog = rng.uniform(1, 8), 0.05 * rng.normal(size=3)
    bias = np.concatenate([3 * rng.normal(size=3), 0.2 * rng.normal(size=3)])
    shape = stand(real_arm(KIND), session_at(q, mass, cog))
    weight = mass * np.array(gravity)
    force = np.einsum("nji,j->ni", shape.flange_rotation, weight)
    noise = rng.normal(size=(len(q), 6)) * np.repeat([FORCE, TORQUE], 3)
    return np.hstack([force, np.cross(cog, force)]) + bias + noise, np.array([mass, *cog, *bias])


@pytest.fixture(scope="module")
def model() -> Model:
    return model_of(real_arm(KIND))


def test_intervals_hold_mass_centre_and_bias_in_95_of_100_sessions(model: Model) -> None:
    held = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        q = rng.uniform(KIND.low, KIND.high, (8, 6))
        wrench, truth = _readings(q, rng)
        found = calibrate_payload(model, q, wrench)
        held += [
            e.interval[0] <= t <= e.interval[1] for e, t in zip(found.estimates, truth, strict=True)
        ]
    assert 0.92 < np.mean(held) < 0.98  # 600 of them


def test_a_bumped_sensor_is_listed_and_hardly_changes_the_load(model: Model) -> None:
    rng = np.random.default_rng(3)
    q = rng.uniform(KIND.low, KIND.high, (8, 6))
    wrench, truth = _readings(q, rng)
    wrench[4, 1] += 30.0
    found = calibrate_payload(model, q, wrench)
    assert list(found.outliers) == [4]
    assert found.mass == pytest.approx(truth[0], abs=0.03)
    assert Note(Reason.READINGS_DOWN, ((5,),)) in found.notes


def test_the_model_carries_the_load_and_the_bias_afterwards(model: Model) -> None:
    rng = np.random.default_rng(5)
    q = rng.uniform(KIND.low, KIND.high, (8, 6))
    wrench, _ = _readings(q, rng)
    found = calibrate_payload(model, q, wrench)
    carried = found.applied(model)
    assert carried.payload_mass == found.mass
    again = found.applied(carried)
    assert [t.effect for t in again.terms].count("ft_bias") == 1


def test_a_sensor_known_to_be_turned_is_read_as_it_stands(model: Model) -> None:
    from gapbridge.core.effects import Site, Term

    rng = np.random.default_rng(6)
    q = rng.uniform(KIND.low, KIND.high, (10, 6))
    wrench, truth = _readings(q, rng)
    bias = truth[4:]
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    sensed = np.hstack([(wrench - bias)[:, :3] @ turn, (wrench - bias)[:, 3:] @ turn]) + bias
    knowing = model.with_terms([Term("ft_misalignment", Site(), (0.0, 0.0, np.pi / 2))])
    found = calibrate_payload(knowing, q, sensed)
    assert found.cog == pytest.approx(truth[1:4], abs=1e-3)


def test_a_base_that_is_known_not_to_be_level_turns_the_weight(model: Model) -> None:
    rng = np.random.default_rng(4)
    q = rng.uniform(KIND.low, KIND.high, (12, 6))
    tilt = 0.05  # rad about x of base
    gravity = (0.0, 9.80665 * np.sin(tilt), -9.80665 * np.cos(tilt))
    wrench, truth = _readings(q, rng, gravity)
    turned = model.with_terms([*model.terms, Term("gravity_direction", Site(), (tilt, 0.0))])
    found = calibrate_payload(turned, q, wrench)
    assert found.noise[0] < 2 * FORCE
    for estimate, value in zip(found.estimates, truth, strict=True):
        assert abs(estimate.value - value) < 5 * estimate.std


def test_orientations_that_hardly_turn_are_refused(model: Model) -> None:
    rng = np.random.default_rng(7)
    q = BEGIN + 0.003 * rng.normal(size=(8, 6))
    wrench, _ = _readings(q, rng)
    with pytest.raises(ExcitationError, match="orientations tens of degrees"):
        calibrate_payload(model, q, wrench)


def test_readings_that_are_no_numbers_are_named(model: Model) -> None:
    wrench = np.zeros((4, 6))
    wrench[2, 1] = np.nan
    with pytest.raises(InputError, match="reading 3"):
        calibrate_payload(model, np.tile(BEGIN, (4, 1)), wrench)


@pytest.mark.parametrize(
    ("fault", "match"),
    [
        (lambda wrench, rotation: np.tile(wrench[:1], (len(wrench), 1)), "the same wrench in ev"),
        (lambda wrench, rotation: wrench[:, [1, 2, 0, 4, 5, 3]], "N .1 sigma. from those of any"),
        (
            lambda wrench, rotation: np.einsum(
                "nij,nkj->nki", rotation, wrench.reshape(-1, 2, 3)
            ).reshape(-1, 6),
            "Nm .1 sigma. from those of any load",
        ),
    ],
    ids=["dead", "axes", "base"],
)
def test_a_sensor_that_is_dead_or_has_other_axes_is_not_taken_for_a_bare_flange(
    model: Model, fault: Callable[[Array, Array], Array], match: str
) -> None:
    rng = np.random.default_rng(8)
    q = rng.uniform(KIND.low, KIND.high, (8, 6))
    load = replace(model, payload_mass=6.0, payload_cog=np.array([0.01, -0.02, 0.08]))
    weight = weight_columns(load, q)[:, :, :4] @ np.array([6.0, 0.06, -0.12, 0.48])
    rotation = load.predict(q).rotation @ load.chain().tool_rotation.T
    with pytest.raises(InputError, match=match):
        calibrate_payload(load, q, fault(weight + 0.01 * rng.normal(size=(8, 6)), rotation))


@pytest.mark.parametrize("axis", range(6))
def test_an_axis_of_the_sensor_that_never_changes_is_named(model: Model, axis: int) -> None:
    rng = np.random.default_rng(8)
    q = rng.uniform(KIND.low, KIND.high, (8, 6))
    wrench = weight_columns(model, q)[:, :, :4] @ np.array([3.0, 0.15, -0.12, 0.15])
    wrench += 0.01 * rng.normal(size=(8, 6))
    wrench[:, axis] = 0.3
    with pytest.raises(InputError, match=f"the same {AXES[axis]} in every orientation"):
        calibrate_payload(model, q, wrench)


def test_an_axis_that_the_load_does_not_change_may_be_constant(model: Model) -> None:
    q = np.random.default_rng(8).uniform(KIND.low, KIND.high, (8, 6))
    wrench = weight_columns(model, q) @ np.array([3.0, 0, 0, 0.15, 1, 2, 3, 0.1, 0.2, 0.3])
    assert np.ptp(wrench[:, 5]) < 1e-12
    assert calibrate_payload(model, q, wrench).mass == pytest.approx(3.0)


def test_planned_orientations_hit_no_obstacle_and_keep_to_the_joint_range(model: Model) -> None:
    limits = model.arm.limits
    lower = np.where(np.arange(6) == 5, BEGIN[5] - 1.0, limits.lower)
    wall = Box((-1.0, -2.0, -1.0), (2.0, -0.45, 2.0))
    workspace = Workspace.of(model, lower=lower, keep_out=[wall])
    workspace = replace(workspace, loads_end=((0.0, 0.0, 0.2),))
    anywhere = np.array(plan_payload(model, BEGIN, poses=20).poses)
    assert not workspace.clear(anywhere).all()
    planned = np.array(plan_payload(model, BEGIN, poses=20, workspace=workspace).poses)
    assert len(planned) == 20
    assert workspace.clear(planned).all()


def test_a_bare_flange_weighs_nothing_and_has_no_centre(model: Model) -> None:
    rng = np.random.default_rng(8)
    q = rng.uniform(KIND.low, KIND.high, (8, 6))
    found = calibrate_payload(model, q, 0.1 * rng.normal(size=(8, 6)))
    assert Note(Reason.NOTHING_WEIGHS) in found.notes
    assert not np.isfinite(found.estimates[1].std)


def test_planned_orientations_are_as_accurate_as_predicted(model: Model) -> None:
    plan = plan_payload(replace(model, payload_mass=2.0), BEGIN, noise=(FORCE, TORQUE))
    assert all(np.array_equal(q[:3], BEGIN[:3]) for q in plan.poses)
    q = np.array(plan.poses)
    found, rng = [], np.random.default_rng(9)
    for _ in range(60):
        wrench, truth = _readings(q, rng)
        found.append(calibrate_payload(model, q, wrench).mass - truth[0])
    assert np.std(found) == pytest.approx(plan.std[0], rel=0.3)


def test_a_wrist_that_cannot_turn_is_reported_when_planning(model: Model) -> None:
    limits = replace(model.arm.limits, lower=BEGIN - 0.051, upper=BEGIN + 0.051)
    fixed = replace(model, arm=replace(model.arm, limits=limits))
    with pytest.raises(ExcitationError, match="cannot turn the flange far enough"):
        plan_payload(fixed, BEGIN)


@pytest.mark.parametrize(("lower", "upper"), [(-0.02, 0.02), (0.0, 0.09), (3.2, 6.0)])
def test_a_wrist_joint_with_hardly_any_range_keeps_within_it(
    model: Model, lower: float, upper: float
) -> None:
    low, high = model.arm.limits.lower.copy(), model.arm.limits.upper.copy()
    low[5], high[5] = lower, upper
    limits = replace(model.arm.limits, lower=low, upper=high)
    plan = plan_payload(replace(model, arm=replace(model.arm, limits=limits)), BEGIN)
    last = np.array(plan.poses)[:, 5]
    assert ((last == BEGIN[5]) | ((last >= lower) & (last <= upper))).all()
