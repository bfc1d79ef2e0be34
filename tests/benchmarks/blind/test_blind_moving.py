"""The moving truth against MuJoCo and against plain integration."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from benchmarks.blind.arms import ARMS
from benchmarks.blind.moving import draw_motion, torque_shares

pytest.importorskip("pinocchio")


def mujoco_arm(rows, gravity, mass, cog):
    """Return the arm as a MuJoCo model: spheres of a negligible inertia at the centres."""
    mujoco = pytest.importorskip("mujoco")
    spec = mujoco.MjSpec()
    spec.option.gravity = gravity
    spec.compiler.autolimits = False
    parent, place, turned = spec.worldbody, np.zeros(3), 0.0
    for i, row in enumerate(rows):
        quaternion = [np.cos(turned / 2), np.sin(turned / 2), 0, 0]
        body = parent.add_body(name=f"b{i}", pos=place, quat=quaternion)
        inner = body
        if row.offset:
            half = row.offset / 2
            inner = body.add_body(name=f"o{i}", quat=[np.cos(half), 0, 0, np.sin(half)])
        inner.add_joint(name=f"j{i}", axis=[0, 0, 1])
        ca, sa = np.cos(row.alpha), np.sin(row.alpha)
        x, y, z = row.cog
        centre = [row.a + x, ca * y - sa * z, row.d + sa * y + ca * z]
        inner.explicitinertial = True
        inner.mass, inner.ipos, inner.inertia = row.mass, centre, [1e-9] * 3
        parent, place, turned = inner, np.array([row.a, 0, row.d]), row.alpha
    flange = parent.add_body(name="load", pos=place,
                             quat=[np.cos(turned / 2), np.sin(turned / 2), 0, 0])  # fmt: skip
    flange.explicitinertial = True
    flange.mass, flange.ipos, flange.inertia = mass, cog, [1e-9] * 3
    return spec.compile()


@pytest.mark.parametrize("name", list(ARMS))
def test_torques_of_a_motion_agree_with_mujoco(name):
    mujoco = pytest.importorskip("mujoco")
    kind = ARMS[name]
    motion = draw_motion(kind, np.random.default_rng(5))
    time = np.linspace(0, 8, 25)
    q, qd, qdd = (motion.at(time, k) for k in range(3))
    mass, cog = 0.4 * kind.rated, np.array([0.02, -0.01, 0.05])
    gravity = np.array([0, 0, -9.80665])
    links, carried = torque_shares(kind.rows, gravity, cog, q, qd, qdd)
    model = mujoco_arm(kind.rows, gravity, mass, cog)
    data = mujoco.MjData(model)
    for k in range(len(time)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
        mujoco.mj_inverse(model, data)
        ours = links[:, k].sum(axis=0) + mass * carried[k]
        assert ours == pytest.approx(data.qfrc_inverse, rel=1e-6, abs=1e-5 * kind.rated)


def test_derivatives_of_a_motion_are_its_derivatives():
    motion = draw_motion(ARMS["cobot10"], np.random.default_rng(1))
    time, step = np.linspace(1, 9, 50), 1e-5
    slope = (motion.at(time + step) - motion.at(time - step)) / (2 * step)
    assert motion.at(time, 1) == pytest.approx(slope, abs=1e-7)
    slope = (motion.at(time + step, 1) - motion.at(time - step, 1)) / (2 * step)
    assert motion.at(time, 2) == pytest.approx(slope, abs=1e-6)


def test_a_lag_is_what_integration_gives():
    kind = ARMS["cobot5"]
    motion = draw_motion(kind, np.random.default_rng(2))
    lag, delay = np.linspace(0.01, 0.06, kind.n), np.linspace(0.002, 0.02, kind.n)
    times = np.linspace(2.0, 4.0, 9)

    def follow(t, y):
        return (motion.at((t - delay)[None])[0] - y) / lag

    start = motion.at(-delay[None])[0]
    run = solve_ivp(follow, (0, 4), start, t_eval=times, rtol=1e-9, atol=1e-11)
    assert motion.lagged(times, delay, lag) == pytest.approx(run.y.T, abs=1e-7)
