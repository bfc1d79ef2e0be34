"""The exact prediction against an independent solution, the linear form to second order."""

import numpy as np
import pytest
from oracle import equilibrium as oracle

from gapbridge.core.arm import arm_from_dh, builtin_rows
from gapbridge.core.errors import InputError
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

SEVEN = [
    {"a": 0.0, "alpha": -np.pi / 2, "d": 0.34, "offset": 0.3, "mass": 4.0, "cog": [0, 0.1, 0.03]},
    {"a": 0.0, "alpha": np.pi / 2, "d": 0.0, "mass": 4.1, "cog": [0.01, 0.06, 0.04]},
    {"a": 0.04, "alpha": np.pi / 2, "d": 0.4, "mass": 3.0, "cog": [0, 0.03, 0.12]},
    {"a": -0.04, "alpha": -np.pi / 2, "d": 0.0, "offset": -0.7, "mass": 2.7, "cog": [0, 0.07, 0]},
    {"a": 0.0, "alpha": -np.pi / 2, "d": 0.4, "mass": 1.7, "cog": [0.02, 0, 0.1]},
    {"a": 0.01, "alpha": np.pi / 2, "d": 0.0, "mass": 1.8, "cog": [0, 0.01, 0.01]},
    {"a": 0.0, "alpha": 0.0, "d": 0.126, "mass": 0.3, "cog": [0, 0, 0.02]},
]
ARMS = {"ur3e": (builtin_rows("ur3e")["dh"], 3.0, 2e-5),
        "ur10e": (builtin_rows("ur10e")["dh"], 12.5, 4e-6),
        "seven": (SEVEN, 14.0, 1e-5)}  # fmt: skip


def predicted(case):
    """Return the model of a case and its single row's pose."""
    tool = np.eye(4)
    tool[:3, :3], tool[:3, 3] = case.tool_rotation.as_matrix(), case.tool_position
    model = Model(arm_from_dh(case.dh), tool, gravity=case.gravity)
    loads = Loads(np.array([case.payload]), case.payload_cog[None], case.wrench[None])
    return model, loads


def compare(count, seed):
    rng = np.random.default_rng(seed)
    position, turn = [], []
    for k in range(count):
        dh, payload, softness = list(ARMS.values())[k % 3]
        case = oracle.random_case(rng, dh, payload, softness * 10 ** rng.uniform(-1, 0.7))
        model, loads = predicted(case)
        poses = model.with_compliance(case.axial, case.radial).predict(case.q[None], loads)
        truth = oracle.solve(case)
        position.append(np.linalg.norm(poses.position[0] - truth[0]))
        turn.append(np.abs(poses.rotation[0] - truth[1]).max())
    return np.array(position), np.array(turn)


def test_predicted_poses_agree_with_an_independent_solution_on_60_cases():
    position, turn = compare(60, 1)
    assert position.max() < 1e-9
    assert turn.max() < 1e-9


@pytest.mark.slow
def test_predicted_poses_agree_with_an_independent_solution_on_1000_cases():
    position, turn = compare(1000, 2)
    assert position.max() < 1e-7
    assert turn.max() < 1e-7


@pytest.mark.parametrize("name", ARMS)
def test_the_linear_forms_error_falls_with_the_square_of_the_compliance(name):
    rng = np.random.default_rng(3)
    dh, payload, softness = ARMS[name]
    ratios = []
    for _ in range(20):
        case = oracle.random_case(rng, dh, payload, softness)
        model, loads = predicted(case)
        rigid = model.predict(case.q[None], loads).position[0]
        A = model.linear_form(case.q[None], loads).regressor[0, :3]
        error = []
        for share in (1.0, 0.5):
            flexibility = share * np.concatenate([case.axial, case.radial])
            deflected = model.with_compliance(share * case.axial, share * case.radial)
            exact = deflected.predict(case.q[None], loads).position[0] - rigid
            error.append(np.linalg.norm(exact - A @ flexibility))
            # the linear form is a first-order statement, not just any small number
            assert error[-1] < 0.05 * np.linalg.norm(exact)
        ratios.append(error[0] / error[1])
    assert 3.9 < np.median(ratios) < 4.1
    assert min(ratios) > 3
    assert max(ratios) < 5


def test_the_linear_forms_orientation_is_that_of_a_small_bend():
    rng = np.random.default_rng(4)
    dh, payload, softness = ARMS["ur10e"]
    case = oracle.random_case(rng, dh, payload, softness)
    model, loads = predicted(case)
    A = model.linear_form(case.q[None], loads).regressor[0, 3:]
    small = 1e-4
    deflected = model.with_compliance(small * case.axial, small * case.radial)
    turn = (
        deflected.predict(case.q[None], loads).rotation[0]
        @ model.predict(case.q[None]).rotation[0].T
    )
    vector = np.array([turn[2, 1], turn[0, 2], turn[1, 0]]) - np.array(
        [turn[1, 2], turn[2, 0], turn[0, 1]]
    )
    linear = small * A @ np.concatenate([case.axial, case.radial])
    np.testing.assert_allclose(vector / 2, linear, atol=1e-3 * np.abs(linear).max())


def test_a_thousand_rows_at_once_are_what_they_are_one_by_one():
    rng = np.random.default_rng(5)
    model = Model(arm_from_dh(SEVEN), payload_mass=5.0).with_compliance([1e-5] * 7, [2e-5] * 7)
    q = rng.uniform(-3, 3, (1000, 7))
    wrench = rng.normal(size=(1000, 6)) * 20
    together = model.predict(q, Loads(wrench=wrench))
    for r in (0, 1, 500, 999):
        alone = model.predict(q[r : r + 1], Loads(wrench=wrench[r : r + 1]))
        np.testing.assert_allclose(together.position[r], alone.position[0], atol=1e-12)


def test_an_arm_that_would_buckle_is_an_input_error_naming_the_row():
    model = Model(arm_from_dh(SEVEN), payload_mass=14.0).with_compliance([0.5] * 7, [0.5] * 7)
    q = np.vstack([np.zeros(7), np.full(7, 0.8)])
    with pytest.raises(InputError, match=r"^row [12]: the arm finds no equilibrium"):
        model.predict(q)
