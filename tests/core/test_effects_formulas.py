"""Effects against their formulas, written once more from their sources: signs, axes, spread."""

from __future__ import annotations

from dataclasses import replace

import moving_truth as truth
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gapbridge.core.arm import Arm, builtin_arm
from gapbridge.core.dynamics import predict_torque, predict_wrench, with_pieces
from gapbridge.core.effects import CATALOGUE, Site, Term
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion, motion_of

JOINT, i = Site(3), 2
UR10E = builtin_arm("ur10e")
Scene = tuple[Model, Motion]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    model = truth.plant(tmp_path_factory.mktemp("arm"), 6, 1).model(payload=2.0)
    t = np.arange(1500) / 500
    course = truth.course(6, 3)
    log = truth.log_of(6, timestamp=t, actual_q=course.at(t), target_q=course.at(t))
    return model, with_pieces(model, motion_of(log))


def more_torque(scene: Scene, *terms: Term) -> np.ndarray:
    """Return what the motors deliver more with the terms (N, n)."""
    return np.asarray(predict_torque(*scene, terms) - predict_torque(*scene))


def test_stribeck_friction_fades_with_the_square_of_the_speed_both_ways(scene: Scene) -> None:
    qd = scene[1].qd[:, i]
    found = more_torque(scene, Term("stribeck_friction", JOINT, (7.0, 0.2)))
    moves = np.abs(qd) > 0.05
    assert (qd[moves] > 0).any() and (qd[moves] < 0).any()
    expected = 7.0 * np.exp(-((qd / 0.2) ** 2)) * np.sign(qd)
    np.testing.assert_allclose(found[moves, i], expected[moves], atol=1e-6)
    assert not np.delete(found, i, axis=1).any()


def test_load_friction_resists_by_the_loads_size_whatever_its_sign(scene: Scene) -> None:
    load, qd = predict_torque(*scene)[:, i], scene[1].qd[:, i]
    found = more_torque(scene, Term("load_friction", JOINT, (0.1,)))[:, i]
    moves = np.abs(qd) > 0.05
    assert (load[moves] > 0).any() and (load[moves] < 0).any()
    np.testing.assert_allclose(found[moves], (0.1 * np.abs(load) * np.sign(qd))[moves], atol=1e-6)


def test_coulomb_friction_is_sure_in_motion_and_undecided_at_rest(scene: Scene) -> None:
    found = more_torque(scene, Term("coulomb_friction", JOINT, (4.0,)))[:, i]
    qd = scene[1].qd[:, i]
    moves = np.abs(qd) > 0.05
    np.testing.assert_allclose(found[moves], 4.0 * np.sign(qd[moves]), atol=1e-6)
    slowest = np.argmin(np.abs(qd))
    assert abs(found[slowest]) < 2.0


def test_a_torques_zero_is_that_of_its_joint_alone(scene: Scene) -> None:
    found = more_torque(scene, Term("torque_offset", JOINT, (1.5,)))
    np.testing.assert_allclose(found, 1.5 * np.eye(6)[i] * np.ones((len(found), 1)), atol=1e-9)


def test_a_shifted_centre_is_the_same_as_a_load_declared_there(scene: Scene) -> None:
    model, motion = scene
    shift = np.array([0.03, -0.02, 0.05])
    term = Term("payload_cog", Site(), tuple(shift))
    loads = replace(motion.loads, payload_cog=np.tile(truth.COG + shift, (len(motion.q), 1)))
    there = with_pieces(model, replace(motion, loads=loads, pieces=None))
    for predict in (predict_wrench, predict_torque):
        expected = predict(model, there)
        np.testing.assert_allclose(predict(model, motion, [term]), expected, atol=1e-9)
        assert np.abs(expected - predict(model, motion)).max() > 0.1


def test_a_joint_rests_short_of_its_target_on_the_side_that_it_came_from() -> None:
    q = np.tile([0.0, -1.2, 1.5, -1.8, -1.5, 0.0], (2, 1))
    from_below_and_above = Loads(approach=np.array([1.0, -1.0])[:, None] * np.ones((2, 6)))
    model = Model(UR10E).with_terms([Term("dead_band", JOINT, (2e-3,))])
    rests = model.settled(q, from_below_and_above)
    np.testing.assert_allclose(rests[:, i] - q[:, i], [-2e-3, 2e-3], atol=1e-12)


def test_a_target_that_slips_on_a_turned_tool_was_where_it_was_before() -> None:
    rng = np.random.default_rng(2)
    tool = np.eye(4)
    tool[:3, :3] = Rotation.from_euler("xyz", [0.4, -0.3, 0.8]).as_matrix()
    tool[:3, 3] = [0.03, -0.05, 0.18]
    model, q = Model(UR10E, tool), rng.uniform(-2, 2, (6, 6))
    slipped = model.with_terms([Term("target_slip", Site(), (1e-3, -2e-3, 3e-3, 2.5))])
    seen = slipped.predict(q, Loads(time=np.arange(6.0))).position
    moved = tool.copy()
    moved[:3, 3] += [1e-3, -2e-3, 3e-3]
    np.testing.assert_allclose(seen[:3], model.predict(q).position[:3], atol=1e-12)
    np.testing.assert_allclose(seen[3:], Model(UR10E, moved).predict(q).position[3:], atol=1e-12)


def along_axis(arm: Arm, joint: int, shift: float) -> Arm:
    """Return the same arm with the frame of a joint (from 1) elsewhere along the joint's axis."""
    links, way = arm.link_in_link.copy(), np.eye(4)
    way[2, 3] = shift
    links[joint - 1] = links[joint - 1] @ way
    links[joint] = np.linalg.inv(way) @ links[joint]
    return replace(arm, link_in_link=links)


@pytest.mark.parametrize("joint", [4, 5])
def test_a_links_measures_do_not_depend_on_where_frames_lie_along_their_axes(joint: int) -> None:
    q = np.random.default_rng(5).uniform(-2, 2, (8, 6))
    term = Term("link_geometry", Site(joint), (1e-3, -2e-3, 0.02))
    elsewhere = along_axis(UR10E, joint + 1, 0.35)
    plain, moved = (Model(arm).predict(q).position for arm in (UR10E, elsewhere))
    np.testing.assert_allclose(moved, plain, atol=1e-12)
    plain, moved = (Model(a).with_terms([term]).predict(q).position for a in (UR10E, elsewhere))
    np.testing.assert_allclose(moved, plain, atol=1e-12)


@pytest.mark.parametrize(
    ("effect", "site", "values", "spread"),
    [("transmission_error", Site(2, 5.0), (3e-4, -2e-4), (2e-5, 1.4e-5)),
     ("stiffness_nonlinearity", Site(2), (1e-5, 1 / 80.0**2), (1e-6, 2e-5))],
)  # fmt: skip
def test_reported_spreads_are_those_of_the_values_that_were_fitted(
    effect: str, site: Site, values: tuple[float, ...], spread: tuple[float, ...]
) -> None:
    member = CATALOGUE[effect]
    covariance = np.outer(spread, spread) * np.array([[1.0, 0.4], [0.4, 1.0]])

    def shown(x: np.ndarray) -> np.ndarray:
        return np.array(
            [r.value for r in member.reported(UR10E, Term(effect, site, tuple(x)), None)]
        )

    steps = 1e-6 * np.diag(np.abs(values))
    jacobian = np.stack(
        [(shown(values + h) - shown(values - h)) / (2 * h.max()) for h in steps], axis=1
    )
    found = [line.std for line in member.reported(UR10E, Term(effect, site, values), covariance)]
    np.testing.assert_allclose(
        found, np.sqrt(np.diag(jacobian @ covariance @ jacobian.T)), rtol=1e-4
    )
