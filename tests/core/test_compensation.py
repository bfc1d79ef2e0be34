"""The corrected setpoint's predicted real pose is the wanted one; unreachable ones are reported."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracle import equilibrium as oracle
from test_equilibrium import SEVEN

from gapbridge.core.arm import arm_from_dh, builtin_arm, builtin_rows
from gapbridge.core.compensation import (
    LARGEST_OFFSET,
    LEVER,
    TOLERANCE,
    Compensator,
    correct,
    wanted_pose,
)
from gapbridge.core.effects import Site, Term
from gapbridge.core.errors import InputError
from gapbridge.core.kernels.least_offset import smallest_offset
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix, rotation_vector

SIX = Model(builtin_arm("ur10e"), payload_mass=8.0).with_compliance([1e-5] * 6, [5e-6] * 6)
WIDE = Model(arm_from_dh(SEVEN), payload_mass=8.0).with_compliance([2e-5] * 7, [1e-5] * 7)
MODELS = {6: SIX, 7: WIDE}


def distance(model, q, nominal_q, loads=None):
    """Return how far (m; rotation times the lever) the predicted pose is from the wanted one."""
    real, wanted = model.predict(q, loads), wanted_pose(model, nominal_q)
    turn = rotation_vector(real.rotation @ np.swapaxes(wanted.rotation, 1, 2))
    apart = np.hstack([real.position - wanted.position, LEVER * turn])
    return np.linalg.norm(apart, axis=1)


def smallest_singular_value(model, q):
    return np.linalg.svd(model.linear_form(q).jacobian)[1].min(axis=1)


@pytest.mark.parametrize("n", [6, 7])
@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_the_corrected_setpoints_real_pose_is_the_wanted_one(n, data):
    model = MODELS[n]
    q = data.draw(arrays(float, (1, n), elements=st.floats(-3, 3)))
    assume(smallest_singular_value(model, q)[0] > 0.05)
    flexibility = data.draw(arrays(float, 2 * n, elements=st.floats(0, 1.5e-5)))
    wrench = data.draw(arrays(float, (1, 6), elements=st.floats(-40, 40)))
    mass = data.draw(arrays(float, 1, elements=st.floats(0, 10)))
    model = model.with_compliance(flexibility[:n], flexibility[n:])
    loads = Loads(payload_mass=mass, wrench=wrench)
    found = correct(model, q, loads)
    assume(np.linalg.norm(found.q - q) < 0.9 * LARGEST_OFFSET)  # damped beyond it
    assert distance(model, found.q, q, loads)[0] < 1e-8
    assert found.residual[0] < 1e-8


@pytest.mark.parametrize("n", [6, 7])
@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_near_singular_poses_the_offset_is_bounded_and_never_worse_than_none(n, data):
    # a UR's and this arm's elbow and wrist are singular at zero
    model = MODELS[n]
    near = st.one_of(st.just(0.0), st.floats(-1e-3, 1e-3), st.floats(-3, 3))
    q = data.draw(arrays(float, (1, n), elements=near))
    found = correct(model, q)
    assert np.isfinite(found.q).all()
    assert np.linalg.norm(found.q - q) <= LARGEST_OFFSET * (1 + 1e-6)
    assert found.residual[0] <= distance(model, q, q)[0] + 1e-12


@pytest.mark.parametrize("n", [6, 7])
def test_the_residual_is_the_distance_that_is_really_left(n):
    model, rng = MODELS[n], np.random.default_rng(1)
    q = np.vstack([rng.uniform(-3, 3, (40, n)), np.zeros((1, n)), np.full((1, n), 1e-5)])
    found = correct(model, q)
    np.testing.assert_allclose(found.residual, distance(model, found.q, q), atol=1e-10)


def test_a_stretched_arm_cannot_reach_where_it_sags_from_and_reports_how_much_is_left():
    found = correct(SIX, np.zeros((1, 6)))
    assert 1e-4 < found.residual[0] < distance(SIX, np.zeros((1, 6)), np.zeros((1, 6)))[0]


@pytest.mark.parametrize("terms", [(), (Term("joint_offset", Site(2), (1e-3,)),)])
@pytest.mark.parametrize("n", [3, 4, 5, 6, 7])
def test_what_few_joints_cannot_correct_counts_apart_from_what_they_missed(n, terms):
    arm = arm_from_dh(SEVEN if n == 7 else builtin_rows("ur10e")["dh"][:n])
    model = Model(arm, payload_mass=5.0).with_compliance([5e-6] * n, [5e-6] * n).with_terms(terms)
    live, rng = Compensator(model), np.random.default_rng(n)
    for q in rng.uniform(0.3, 1.2, (20, n)):
        found = live.correct(q)
        jacobian = model.linear_form(found.q[None]).jacobian[0] * np.repeat([1, LEVER], 3)[:, None]
        real, wanted = model.predict(found.q[None]), wanted_pose(model, q)
        turn = rotation_vector(wanted.rotation[0] @ real.rotation[0].T)
        error = np.append(wanted.position[0] - real.position[0], LEVER * turn)
        basis = np.linalg.svd(jacobian, full_matrices=False)[0]
        missed = live.missed(q, Loads(), found.residual)
        assert missed == pytest.approx(np.linalg.norm(basis.T @ error), abs=1e-9)
        assert missed < 1e-6
        assert (found.residual > 1e-5) == (n < 6)
    away = live.correct(q)
    live._offset[0] += 1e-3  # a solution that was not found
    assert live.missed(q, Loads(), away.residual) > 1e-5 or n >= 6


@pytest.mark.parametrize("shape", [(5,), (7,), (1, 6)])
def test_a_setpoint_of_another_arm_is_refused(shape):
    with pytest.raises(InputError, match=r"nominal_q: found an array .*, expected \(6,\)"):
        Compensator(Model(builtin_arm("ur10e"))).correct(np.zeros(shape))


@pytest.mark.parametrize("n", [6, 7])
def test_a_rigid_arm_gets_no_offset(n):
    rigid = MODELS[n].without_terms()
    q = np.random.default_rng(2).uniform(-3, 3, (20, n))
    found = correct(rigid, q)
    np.testing.assert_array_equal(found.q, q)
    np.testing.assert_array_equal(found.offset_in_base[:, :3], 0)
    assert np.abs(found.offset_in_base).max() < 1e-15
    assert found.residual.max() < 1e-14
    assert (found.steps == 1).all()


def test_without_weight_and_pull_a_soft_arm_gets_no_offset():
    q = np.random.default_rng(3).uniform(-3, 3, (5, 6))
    soft = Model(builtin_arm("ur10e"), gravity=np.zeros(3)).with_compliance([1e-3] * 6, [1e-3] * 6)
    np.testing.assert_allclose(correct(soft, q).q, q, atol=1e-15)


@pytest.mark.parametrize("n", [6, 7])
def test_the_offset_in_base_is_what_the_rigid_tool_moves_by(n):
    model = MODELS[n]
    q = np.random.default_rng(4).uniform(-2, 2, (10, n))
    found = correct(model, q)
    before, after = model.rigid_pose(q), model.rigid_pose(found.q)
    np.testing.assert_allclose(
        found.offset_in_base[:, :3], after.position - before.position, atol=1e-12
    )
    turn = rotation_vector(after.rotation @ np.swapaxes(before.rotation, 1, 2))
    np.testing.assert_allclose(found.offset_in_base[:, 3:], turn, atol=1e-12)


def test_the_correction_holds_for_an_arm_that_bends_by_other_code():
    rng = np.random.default_rng(5)
    for _ in range(10):
        case = oracle.random_case(rng, builtin_rows("ur10e")["dh"], 8.0, 3e-6)
        tool = np.eye(4)
        tool[:3, :3], tool[:3, 3] = case.tool_rotation.as_matrix(), case.tool_position
        model = Model(arm_from_dh(case.dh), tool, gravity=case.gravity)
        model = model.with_compliance(case.axial, case.radial)
        loads = Loads(np.array([case.payload]), case.payload_cog[None], case.wrench[None])
        wanted = model.rigid_pose(case.q[None])
        if smallest_singular_value(model, case.q[None])[0] < 0.03:
            continue
        found = correct(model, case.q[None], loads)
        position, rotation = oracle.solve(oracle.Case(**{**case.__dict__, "q": found.q[0]}))
        np.testing.assert_allclose(position, wanted.position[0], atol=1e-8)
        np.testing.assert_allclose(rotation, wanted.rotation[0], atol=1e-8)


def test_with_seven_joints_the_offset_is_the_shortest_one():
    q = np.random.default_rng(6).uniform(-2, 2, (30, 7))
    q = q[smallest_singular_value(WIDE, q) > 0.1]
    offset = correct(WIDE, q).q - q
    J = WIDE.linear_form(q).jacobian
    for r in range(len(q)):
        idle = np.linalg.svd(J[r])[2][6]  # turns the joints and leaves the tool where it is
        assert abs(idle @ offset[r]) < 0.02 * np.linalg.norm(offset[r])


def test_the_offset_of_a_redundant_arm_does_not_pile_up_along_a_path():
    time = np.linspace(0, 200, 20_000)[:, None]
    path = 0.6 + 0.5 * np.sin(time * np.array([1, 1.3, 0.7, 0.9, 1.1, 0.6, 0.8]))
    live = Compensator(WIDE)
    last = [live.correct(q) for q in path[:3000]][-1]
    fresh = Compensator(WIDE).correct(path[2999])
    np.testing.assert_allclose(last.q, fresh.q, atol=1e-6)


@pytest.mark.parametrize("n", [6, 7])
def test_rows_at_once_are_the_rows_one_by_one(n):
    model, rng = MODELS[n], np.random.default_rng(7)
    q = rng.uniform(-2, 2, (60, n))
    q = q[smallest_singular_value(model, q) > 0.1]
    loads = Loads(payload_mass=rng.uniform(0, 9, len(q)), wrench=rng.normal(size=(len(q), 6)) * 20)
    together = correct(model, q, loads)
    for r in range(len(q)):
        alone = Compensator(model).correct(q[r], loads[r : r + 1])
        np.testing.assert_allclose(together.q[r], alone.q, atol=1e-7)


@pytest.mark.parametrize("n", [6, 7])
def test_blocks_of_rows_reach_what_one_setpoint_after_the_other_reaches(n):
    model, rng, count = MODELS[n], np.random.default_rng(8), 150
    q = rng.uniform(-2, 2, (count, n))
    q[7] = 0.0  # singular, and out of reach
    some = Loads(
        payload_mass=rng.uniform(0, 9, count), wrench=rng.normal(size=(count, 6)) * 20,
        payload_cog=rng.uniform(-0.1, 0.1, (count, 3)),
    )  # fmt: skip
    for loads in (Loads(), some):
        live, together = Compensator(model), correct(model, q, loads)
        alone = []
        for r in range(count):
            live.reset()
            alone.append(live.correct(q[r], loads[r : r + 1]))
        residual = np.array([one.residual for one in alone])
        reached = residual < TOLERANCE
        assert 0.9 * count < reached.sum() <= count - (n == 6)
        np.testing.assert_array_equal(together.residual < TOLERANCE, reached)
        # a nanometre that is left is more in the joints, the nearer to a singularity
        atol = 1e-8 / smallest_singular_value(model, q)
        for r in np.flatnonzero(reached):
            np.testing.assert_allclose(together.q[r], alone[r].q, rtol=0, atol=atol[r])
            np.testing.assert_allclose(
                together.offset_in_base[r], alone[r].offset_in_base, rtol=0, atol=1e-8
            )
        np.testing.assert_allclose(together.residual[~reached], residual[~reached], rtol=0.5)


BAD = {
    "joint": (np.full(6, np.nan), None),
    "wrench": (np.full(6, 0.5), Loads(wrench=np.full((1, 6), np.nan))),
    "endless pull": (np.full(6, 0.5), Loads(wrench=np.full((1, 6), np.inf))),
    "load": (np.full(6, 0.5), Loads(payload_mass=np.array([1e7]))),
}


@pytest.mark.parametrize("terms", [(), (Term("joint_offset", Site(2), (0.0,)),)])
@pytest.mark.parametrize("what", BAD)
def test_what_cannot_be_solved_says_so_and_spoils_no_later_setpoint(what, terms):
    live = Compensator(SIX.with_terms(terms))  # with terms row by row
    good = np.array([0.3, -1.2, 1.4, -0.5, 0.8, 0.2])
    before = live.correct(good)
    assert live.correct(*BAD[what]).residual == np.inf
    after = live.correct(good)
    np.testing.assert_allclose(after.q, before.q, atol=1e-9)
    assert after.residual < 1e-8


@pytest.mark.parametrize("what", BAD)
def test_what_cannot_be_solved_is_the_nominal_setpoint_also_where_servos_droop(what):
    live = Compensator(SIX.with_terms([Term("servo_droop", Site(2), (1e-4,))]))
    live.correct(np.array([0.3, -1.2, 1.4, -0.5, 0.8, 0.2]))  # leaves its torques behind
    q, loads = BAD[what]
    found = live.correct(q, loads)
    assert found.residual == np.inf
    np.testing.assert_array_equal(found.q, q)
    np.testing.assert_array_equal(found.offset_in_base, 0.0 * q)


def model_of(n, rng, softness=5e-6):
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = rotation_matrix(rng.normal(size=3)), rng.uniform(-0.2, 0.2, 3)
    arm = builtin_arm("ur10e") if n == 6 else arm_from_dh(SEVEN)
    model = Model(arm, tool, payload_mass=6.0, payload_cog=np.array([0.02, 0.0, 0.08]))
    return model.with_compliance(rng.uniform(0, 2, n) * softness, rng.uniform(0, 2, n) * softness)


def loads_of(rng, rows=1):
    return Loads(rng.uniform(0, 10, rows), rng.uniform(-0.1, 0.1, (rows, 3)),
                 rng.normal(size=(rows, 6)) * [40, 40, 40, 5, 5, 5])  # fmt: skip


@pytest.mark.parametrize("n", [6, 7])
@given(seed=st.integers(0, 2**31))
@settings(max_examples=100, deadline=None)
def test_the_predicted_pose_of_a_reached_setpoint_is_the_wanted_one(n, seed):
    rng = np.random.default_rng(seed)
    model, q, loads = model_of(n, rng), rng.uniform(-np.pi, np.pi, (3, n)), loads_of(rng, 3)
    result = correct(model, q, loads)
    left = distance(model, result.q, q, loads)
    assert (left[result.residual < TOLERANCE] < 1e-8).all()
    # honest: what is reported is what is left, the rotation counted at a lever of half a metre
    np.testing.assert_allclose(result.residual, left, atol=2e-9, rtol=1e-3)
    assert np.isfinite(result.q).all()


@pytest.mark.parametrize("n", [6, 7])
def test_nearly_every_random_pose_is_reached(n):
    rng = np.random.default_rng(n)
    model, q, loads = model_of(n, rng), rng.uniform(-np.pi, np.pi, (400, n)), loads_of(rng, 400)
    result = correct(model, q, loads)
    assert (result.residual < TOLERANCE).mean() > 0.97
    assert np.median(result.steps) <= 4


# a UR's wrist, elbow and shoulder singularities; a seven-joint arm stretched out
SINGULAR = {
    "wrist": [0.3, -1.2, 1.3, -0.7, 0.0, 0.4],
    "elbow": [0.3, -1.2, 0.0, -0.7, 0.8, 0.4],
    "all zero": [0.0] * 6,
    "upright": [0.0, -np.pi / 2, 0.0, -np.pi / 2, 0.0, 0.0],
    "seven stretched": [0.0] * 7,
}


@pytest.mark.parametrize("name", SINGULAR)
@pytest.mark.parametrize("away", [0.0, 1e-12, 1e-7, 1e-4, 1e-2])
def test_near_singularities_setpoints_stay_finite_and_close_and_the_residual_honest(name, away):
    rng = np.random.default_rng(3)
    at = np.array(SINGULAR[name])
    model, loads = model_of(len(at), rng), loads_of(rng, 1)
    q = (at + away * rng.normal(size=len(at)))[None]
    result = correct(model, q, loads)
    assert np.isfinite(result.q).all()
    assert np.isfinite(result.offset_in_base).all()
    # never worse than doing nothing
    left = distance(model, result.q, q, loads)
    assert left[0] <= distance(model, q, q, loads)[0] + 1e-12
    np.testing.assert_allclose(result.residual, left, atol=2e-9, rtol=1e-3)


@pytest.mark.parametrize("n", [6, 7])
def test_live_correction_along_a_path_is_smooth_and_what_it_is_from_a_cold_start(n):
    rng = np.random.default_rng(5)
    model = model_of(n, rng)
    q = np.linspace(np.full(n, 1.2), np.full(n, 1.6), 50)
    live = Compensator(model)
    path = np.array([live.correct(row).q for row in q])
    for r in (0, 25, 49):
        cold = Compensator(model).correct(q[r])
        real = model.predict(np.vstack([path[r], cold.q])).position
        np.testing.assert_allclose(real[0], real[1], atol=1e-8)
    # smooth: the offset's slope does not jump between neighbours
    assert np.abs(np.diff(path - q, 2, axis=0)).max() < 5e-5


@pytest.mark.parametrize("n", [6, 7])
def test_effects_that_look_at_the_joint_angles_take_another_way_to_the_same_setpoint(n):
    rng = np.random.default_rng(8)
    model = model_of(n, rng)
    still = model.with_terms([Term("joint_offset", Site(2), (0.0,))])  # an effect that does nothing
    plain, conditioned = Compensator(model), Compensator(still)
    assert still.conditions()
    for q in np.linspace(np.full(n, 0.4), np.full(n, 1.6), 40):
        loads = loads_of(rng)
        one, other = plain.correct(q, loads), conditioned.correct(q, loads)
        np.testing.assert_allclose(one.q, other.q, atol=1e-12)
        np.testing.assert_allclose(one.offset_in_base, other.offset_in_base, atol=1e-12)
        assert one.steps == other.steps
        assert one.residual == pytest.approx(other.residual, abs=1e-12)


def test_effects_that_look_at_the_joint_angles_are_corrected():
    rng = np.random.default_rng(9)
    model = model_of(6, rng).with_terms(
        [Term("joint_offset", Site(2), (2e-3,)), Term("backlash", Site(3), (1e-3,))]
    )
    q = np.array([[0.3, -1.2, 1.4, -0.5, 0.8, 0.2]])
    loads = replace(loads_of(rng), approach=np.array([[1.0, -1, 1, -1, 1, 1]]))
    found = correct(model, q, loads)
    assert found.residual[0] < 1e-8
    assert distance(model, found.q, q, loads)[0] < 1e-8
    assert abs(found.q[0, 1] - q[0, 1]) > 1e-3


@pytest.mark.parametrize("terms", [(), (Term("joint_offset", Site(2), (0.0,)),)])
def test_loads_count_for_their_own_setpoint_alone(terms):
    model, q = SIX.with_terms(terms), np.array([0.3, -1.2, 1.4, -0.5, 0.8, 0.2])
    live = Compensator(model)
    before = live.correct(q)
    loads = Loads(np.array([1.0]), np.array([[0.1, 0.0, 0.2]]), np.full((1, 6), 20.0))
    pulled = live.correct(q, loads)
    assert np.abs(pulled.q - before.q).max() > 1e-5
    np.testing.assert_allclose(pulled.q, Compensator(model).correct(q, loads).q, atol=1e-9)
    np.testing.assert_allclose(live.correct(q).q, before.q, atol=1e-9)


def test_an_effect_is_corrected_where_the_arm_goes_and_not_where_it_was_to_be():
    wave = Term("transmission_error", Site(2, 40), (2e-3, 1e-3))
    model, q = SIX.with_terms([wave]), np.array([[0.3, -1.2, 1.4, -0.5, 0.8, 0.2]])
    found = correct(model, q)
    assert found.residual[0] < 1e-8
    assert distance(model, found.q, q)[0] < 1e-8


def test_a_correction_stays_what_it_was_when_the_next_one_is_made():
    live, q = Compensator(SIX), np.array([0.3, -1.2, 1.4, -0.5, 0.8, 0.2])
    first = live.correct(q)
    kept = first.q.copy(), first.offset_in_base.copy()
    live.correct(q + 0.1, Loads(payload_mass=np.array([1.0])))
    np.testing.assert_array_equal(first.q, kept[0])
    np.testing.assert_array_equal(first.offset_in_base, kept[1])
    # and nothing of the other payload is left
    np.testing.assert_allclose(live.correct(q).q, first.q, atol=1e-9)


@pytest.mark.parametrize("n", [5, 6, 7])
@given(seed=st.integers(0, 2**31))
@settings(max_examples=60, deadline=None)
def test_the_smallest_offset_is_least_squares(n, seed):
    rng = np.random.default_rng(seed)
    J, wanted, offset = rng.normal(size=(6, n)), 1e-3 * rng.normal(size=6), np.empty(n)
    smallest_offset(J, wanted, offset)
    expected = np.linalg.lstsq(J, wanted, rcond=1e-12)[0]
    if np.linalg.norm(expected) < LARGEST_OFFSET:
        condition = np.linalg.cond(J) ** 2
        np.testing.assert_allclose(offset, expected, atol=1e-15 * condition + 1e-13)
    else:
        assert np.linalg.norm(offset) <= LARGEST_OFFSET * (1 + 1e-9)
