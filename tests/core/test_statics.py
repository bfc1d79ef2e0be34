"""Joint moments against Pinocchio's inverse dynamics at rest."""

import numpy as np
import pytest
from oracle import rigid
from test_kinematics import ROWS, TCP, model_of

from gapbridge.core.loads import Loads
from gapbridge.core.model import Model


@pytest.mark.parametrize("name", ROWS)
def test_moments_of_gravity_payload_and_pull_are_pinocchios(name):
    rng = np.random.default_rng(3)
    gravity = np.array([1.0, -2.0, -9.4])
    base = model_of(name)
    model = Model(base.arm, base.tool_in_flange, gravity=gravity)
    oracle = rigid.from_dh(ROWS[name])
    count = 30
    q = rng.uniform(-np.pi, np.pi, (count, model.arm.n))
    loads = Loads(
        rng.uniform(0, 10, count), rng.uniform(-0.1, 0.1, (count, 3)),
        rng.normal(size=(count, 6)) * 30,
    )  # fmt: skip
    moment = model.linear_form(q, loads).moment
    for r in range(count):
        wanted = rigid.joint_moments(
            oracle, q[r], gravity, TCP, loads.wrench[r], loads.payload_mass[r], loads.payload_cog[r]
        )
        np.testing.assert_allclose(moment[r], wanted, atol=1e-9)


def test_the_models_own_payload_counts_where_the_rows_have_none():
    base = model_of("ur10e")
    cog = np.array([0.01, 0.02, 0.03])
    model = Model(base.arm, base.tool_in_flange, 4.0, cog)
    q = np.full((1, 6), 0.5)
    by_rows = base.linear_form(q, Loads(np.array([4.0]), cog[None])).moment
    np.testing.assert_allclose(model.linear_form(q).moment, by_rows, atol=1e-12)
    heavier = model.linear_form(q, Loads(payload_mass=np.array([6.0]))).moment
    assert np.abs(heavier - by_rows).max() > 1


def test_the_pull_on_the_tool_acts_at_the_tcp_and_not_at_the_flange():
    model = model_of("ur10e")
    q = np.full((1, 6), 0.5)
    pull = np.array([[10.0, 0, 0, 0, 0, 0]])
    more = model.linear_form(q, Loads(wrench=pull)).moment - model.linear_form(q).moment
    tcp = model.rigid_pose(q).position[0]
    # joint 1 of a UR sits in the base's origin
    np.testing.assert_allclose(more[0, 0], np.cross(tcp, pull[0, :3]), atol=1e-10)
