from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from gapbridge.core.arm import builtin_arm
from gapbridge.core.effects import Site, Term
from gapbridge.core.errors import ArmError
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.drivers.simulated.plant import rotations as rot
from gapbridge.drivers.simulated.plant.kinematics import frame_of, gap, pose_of, solve, tcp_in_base
from gapbridge.drivers.simulated.plant.plant import Load, Plant
from gapbridge.drivers.simulated.plant.plant_arm import plant_arm
from gapbridge.drivers.simulated.plant.plant_settings import draw_plant_settings

START = (0.3, -1.4, 1.2, -1.3, -1.5, 0.4)
TCP = (0.02, -0.01, 0.18, 0.1, -0.2, 0.3)


def make_plant(name: str = "ur10e", **changes: object) -> Plant:
    arm = plant_arm(name)
    settings = replace(draw_plant_settings(arm, 3), tcp=TCP, **changes)  # type: ignore[arg-type]
    return Plant(arm, settings, START)


@pytest.mark.parametrize("name", ["ur3e", "ur10e", "ur30"])
def test_the_plant_and_the_model_agree_though_they_share_no_mathematics(name: str) -> None:
    plant = make_plant(name)
    tool = np.eye(4)
    tool[:3, :3] = np.reshape(rot.from_vector(TCP[3:]), (3, 3))
    tool[:3, 3] = TCP[:3]
    model = Model(arm=builtin_arm(name), tool_in_flange=tool).with_compliance(
        axial=np.array(plant.settings.axial), radial=np.array(plant.settings.radial)
    )
    random = np.random.default_rng(1)
    for _ in range(20):
        q = random.uniform(-2.5, 2.5, 6)
        mass, cog = random.uniform(0.0, 10.0), random.normal(0.0, 0.05, 3)
        wrench = random.normal(0.0, 30.0, 6)
        plant.q = tuple(q)
        plant.scatter = (0.0,) * 6
        plant.load = Load(mass, tuple(cog), tuple(wrench[:3]), tuple(wrench[3:]))
        found = plant.true_tcp()
        loads = Loads(payload_mass=np.array([mass]), payload_cog=cog[None], wrench=wrench[None])
        pose = model.predict(q[None], loads)
        assert found.origin == pytest.approx(pose.position[0], abs=1e-9)
        assert found.rotation == pytest.approx(pose.rotation[0].ravel(), abs=1e-9)


def test_servos_give_way_by_what_the_bent_arm_holds() -> None:
    """As the model has it; a rigid arm's torques are 4 % others at joint 2, 20 % at joint 4."""
    soft, droop = (0.0, 3e-4, 3e-4, 8e-4, 8e-4, 8e-4), (0.0, 2e-5, 5e-5, 1e-3, 1e-3, 0.0)
    plant = make_plant(axial=soft, radial=soft, droop=droop)
    plant.set_load(8.0, (0.05, 0.02, 0.1))
    plant.set_force((20.0, -10.0, -30.0), (0.0, 2.0, 0.0))
    tool = np.eye(4)
    tool[:3, :3] = np.reshape(rot.from_vector(TCP[3:]), (3, 3))
    tool[:3, 3] = TCP[:3]
    model = Model(builtin_arm("ur10e"), tool).with_compliance(np.array(soft), np.array(soft))
    terms = [Term("servo_droop", Site(i + 1), (c,)) for i, c in enumerate(droop) if c]
    loads = Loads(
        payload_mass=np.array([8.0]), payload_cog=np.array([[0.05, 0.02, 0.1]]),
        wrench=np.array([[20.0, -10.0, -30.0, 0.0, 2.0, 0.0]]),
    )  # fmt: skip
    for _ in range(300):  # 2.4 s
        plant.step(START, 0.008)
        plant.scatter = (0.0,) * 6
    expected = model.with_terms(terms).settled(np.array([START]), loads)[0]
    assert np.abs(expected - START).max() > 1e-3
    assert plant.q == pytest.approx(expected, abs=1e-9)


def test_one_soft_joint_sags_as_reckoned_by_hand() -> None:
    """One loaded joint: the stretched arm sags by C_a M L with M = (m g) L plus the links."""
    plant = make_plant(axial=(0.0, 1e-5, 0.0, 0.0, 0.0, 0.0), radial=(0.0,) * 6)
    flat = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    empty = plant.shape(flat, Load(0.0, (0.0, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3)).frames[-1]
    loaded = plant.shape(flat, Load(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, -10.0), (0.0,) * 3)).frames[-1]
    tip = rot.add(loaded.origin, rot.rotate(loaded.rotation, plant.tool.origin))
    shoulder = plant.arm.frames(flat)[1].origin
    lever_tip = math.hypot(tip[0] - shoulder[0])
    lever = abs(loaded.origin[0] - shoulder[0])
    sag = empty.origin[2] - loaded.origin[2]
    assert sag == pytest.approx(1e-5 * 10.0 * lever_tip * lever, rel=1e-3)


def test_a_pull_turned_round_bends_the_other_way() -> None:
    plant = make_plant()

    def height(pull: float) -> float:
        load = Load(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, pull), (0.0, 0.0, 0.0))
        return plant.shape(START, load).frames[-1].origin[2]

    assert height(50.0) > height(0.0) > height(-50.0)
    assert height(50.0) - height(0.0) == pytest.approx(height(0.0) - height(-50.0), rel=1e-2)


def test_the_seed_draws_the_plant_and_stays_in_its_ranges() -> None:
    arm = plant_arm("ur10e")
    assert draw_plant_settings(arm, 5) == draw_plant_settings(arm, 5)
    assert draw_plant_settings(arm, 5) != draw_plant_settings(arm, 6)
    many = [draw_plant_settings(arm, seed) for seed in range(200)]
    axial = np.array([s.axial for s in many])
    radial = np.array([s.radial for s in many])
    assert axial.min() >= 3e-6
    assert axial.max() <= 2e-5
    assert radial.min() >= 0.5e-6
    assert radial.max() <= 4e-6
    assert np.all(np.diff(axial.mean(axis=0)) > 0)


def test_joints_follow_with_lag_and_end_exactly_on_the_command() -> None:
    plant = make_plant()
    goal = (START[0] + 0.01, *START[1:])
    plant.step(goal, 0.002)
    assert START[0] < plant.q[0] < goal[0]
    for _ in range(300):
        plant.step(goal, 0.002)
    assert plant.q == goal
    assert plant.qd == (0.0,) * 6


def test_joints_keep_their_velocity_and_acceleration_limits() -> None:
    plant = make_plant()
    before, fastest, hardest = plant.qd[0], 0.0, 0.0
    for _ in range(500):
        plant.step((START[0] + 2.0, *START[1:]), 0.002)
        fastest = max(fastest, abs(plant.qd[0]))
        hardest = max(hardest, abs(plant.qd[0] - before) / 0.002)
        before = plant.qd[0]
    assert fastest == pytest.approx(plant.arm.velocity[0])
    assert hardest <= plant.settings.acceleration_limit * 1.001


def test_each_rest_after_a_move_draws_a_placement_error_of_the_stated_size() -> None:
    plant = make_plant()
    tips = []
    for k in range(60):
        goal = (START[0] + (0.05 if k % 2 else 0.0), *START[1:])
        for _ in range(160):
            plant.step(goal, 0.002)
        if k % 2 == 0:
            tips.append(plant.true_tcp().origin)
    assert plant.placements >= 59
    scatter = np.array(tips[1:]) - np.mean(tips[1:], axis=0)
    assert 1.5e-5 < np.sqrt((scatter**2).sum(axis=1).mean()) < 8e-5


def test_without_a_move_the_placement_stays() -> None:
    plant = make_plant()
    before = plant.scatter
    for k in range(500):
        plant.step((START[0] + 1e-6 * math.sin(k), *START[1:]), 0.002)
    assert plant.scatter == before


def test_an_arm_of_seven_joints_is_refused_by_name_of_the_reason() -> None:
    seven = builtin_arm("ur10e")
    seven = replace(
        seven,
        mass=np.zeros(7),
        cog=np.zeros((7, 3)),
        link_in_link=np.tile(np.eye(4), (8, 1, 1)),
    )
    with pytest.raises(ArmError, match="found 7 joints, expected 6"):
        plant_arm(seven, 6)
    assert len(plant_arm(seven).mass) == 7


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.5, 3.0, math.pi - 1e-9, math.pi])
def test_rotation_vectors_go_there_and_back(angle: float) -> None:
    axis = np.array([0.6, -0.48, 0.64])
    turned = rot.from_vector(tuple(axis * angle))
    back = rot.from_vector(rot.to_vector(turned))
    assert back == pytest.approx(turned, abs=1e-8)
    whole = np.reshape(rot.compose(turned, rot.transpose(turned)), (3, 3))
    assert whole == pytest.approx(np.eye(3))


def test_inverse_kinematics_finds_the_joints_back_and_says_so_where_there_are_none() -> None:
    arm, tool = plant_arm("ur5e"), frame_of(TCP)
    target = tcp_in_base(arm, START, tool)
    near = tuple(v + 0.2 for v in START)
    found = solve(arm, target, near, tool)
    assert found is not None
    assert max(map(abs, gap(tcp_in_base(arm, found, tool), target))) < 1e-10
    pose = list(pose_of(target))
    pose[0] = 5.0
    assert solve(arm, frame_of(pose), START, tool) is None
