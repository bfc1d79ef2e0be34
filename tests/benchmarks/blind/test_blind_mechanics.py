"""The truth generator against closed forms and other people's engines."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from benchmarks.blind.arms import ARMS, SEVEN, urdf_text
from benchmarks.blind.bench import draw_bench
from benchmarks.blind.mechanics import RealArm, Row, Session, stand
from benchmarks.blind.session import Plan, play

G = 9.80665


def session_of(q, mass=0.0, cog=(0, 0, 0), wrench=(0,) * 6, temperature=25.0):
    q = np.atleast_2d(np.asarray(q, dtype=float))
    count, n = q.shape
    return Session(
        time=np.arange(count, dtype=float),
        q=q,
        payload_mass=np.full(count, float(mass)),
        payload_cog=np.tile(np.asarray(cog, dtype=float), (count, 1)),
        tcp_wrench=np.tile(np.asarray(wrench, dtype=float), (count, 1)),
        temperature=np.full((count, n), float(temperature)),
        approach=np.ones((count, n)),
        from_where=q - 0.05,
    )


def planar(lengths, gravity=(0.0, -G, 0.0), **more):
    """Return an arm in the xy plane, gravity along -y, so that every axis carries moment."""
    n = len(lengths)
    rows = tuple(Row(a=length, alpha=0.0, d=0.0) for length in lengths)
    base = RealArm(rows, np.zeros(3), np.eye(3), np.zeros(n), np.zeros(n), np.array(gravity))
    return replace(base, **more)


def test_one_soft_joint_hangs_where_moment_and_spring_agree():
    length, mass, soft = 0.8, 10.0, 2e-3
    arm = planar([length], axial=np.array([soft]))
    angle = brentq(lambda t: t + soft * mass * G * length * np.cos(t), -1.0, 0.0)
    tcp = stand(arm, session_of([0.0], mass)).tcp[0]
    assert tcp == pytest.approx([length * np.cos(angle), length * np.sin(angle), 0], abs=1e-11)


def test_a_stiffening_joint_follows_its_curve():
    length, mass, soft, knee = 0.5, 20.0, 1e-3, 40.0
    arm = planar([length], deflected={0: (soft, knee)})

    def off(t):
        moment = -mass * G * length * np.cos(t)
        return t - soft * moment / np.sqrt(1 + (moment / knee) ** 2)

    angle = brentq(off, -1.0, 0.0)
    tcp = stand(arm, session_of([0.0], mass)).tcp[0]
    assert np.arctan2(tcp[1], tcp[0]) == pytest.approx(angle, abs=1e-11)


def test_a_radially_soft_joint_turns_about_its_moment_not_its_axis():
    # gravity along -z now: the moment of a load on x lies along y, across the joint's axis
    length, mass, soft = 0.6, 5.0, 1e-3
    arm = planar([length], gravity=(0, 0, -G), radial=np.array([soft]))
    angle = brentq(lambda t: t - soft * mass * G * length * np.cos(t), 0.0, 1.0)
    tcp = stand(arm, session_of([0.0], mass)).tcp[0]
    assert tcp == pytest.approx([length * np.cos(angle), 0, -length * np.sin(angle)], abs=1e-11)


@pytest.mark.parametrize("way", [1, 2])
def test_a_soft_link_bends_as_a_cantilever(way):
    length, tool, force, soft = 0.7, 0.2, 3.0, 1e-5
    arm = planar([length, 0.0], tool_position=np.array([tool, 0, 0]),
                 link_softness=np.array([soft, 0.0]))  # fmt: skip
    wrench = np.zeros(6)
    wrench[way] = force
    shape = stand(arm, session_of([0.0, 0.0], wrench=wrench))
    shift = soft * force * (length**3 / 3 + tool * length**2 / 2)
    slope = soft * force * (length**2 / 2 + tool * length)
    assert shape.end[0][0][way] == pytest.approx(shift, rel=1e-6)
    assert shape.tcp[0][way] - shape.end[0][0][way] == pytest.approx(tool * slope, rel=1e-6)


def test_a_soft_link_neither_stretches_nor_twists():
    arm = planar([0.7, 0.0], link_softness=np.array([1e-3, 0.0]))
    pulled = stand(arm, session_of([0.0, 0.0], wrench=(500, 0, 0, 20, 0, 0)))
    assert pulled.tcp[0] == pytest.approx([0.7, 0, 0], abs=1e-12)
    assert pulled.tcp_rotation[0] == pytest.approx(np.eye(3), abs=1e-12)


def test_a_soft_base_tilts_under_the_whole_moment():
    length, mass, soft = 0.5, 8.0, 1e-4
    arm = planar([length], gravity=(0, 0, -G), base_softness=(0.0, soft))
    angle = brentq(lambda t: t - soft * mass * G * length * np.cos(t), 0.0, 1.0)
    tcp = stand(arm, session_of([0.0], mass)).tcp[0]
    assert tcp == pytest.approx([length * np.cos(angle), 0, -length * np.sin(angle)], abs=1e-11)


def test_an_isotropic_soft_base_is_a_radially_soft_joint_1():
    bench = draw_bench(np.random.default_rng(3), Plan(poses=20), arm="heavy210", compliant=False)
    base = replace(bench.nominal, base_softness=(3e-8, 3e-8))
    radial = replace(bench.nominal, radial=np.array([3e-8, 0, 0, 0, 0, 0]))
    a, b = stand(base, bench.session).tcp, stand(radial, bench.session).tcp
    assert np.abs(a - bench.model.tcp).max() > 1e-4
    assert np.abs(a - b).max() < 1e-8


def test_links_grow_with_their_temperature_and_nothing_else_does():
    arm = planar([0.5, 0.3], tool_position=np.array([0.1, 0, 0]), expansion=1e-5)
    tcp = stand(arm, session_of([0.0, 0.0], temperature=45.0)).tcp[0]
    assert tcp[0] == pytest.approx(0.8 * (1 + 20e-5) + 0.1, abs=1e-14)


def test_play_remembers_the_last_motion():
    session = session_of([[0.0], [1.0], [0.4], [0.4], [0.9]])
    session = replace(session, from_where=session.q, approach=np.zeros((5, 1)))
    # from mid-gap: up to the upper flank, back to the lower one, at rest nothing changes
    assert play(session, 0, 0.01) == pytest.approx([0, -0.005, 0.005, 0.005, -0.005])


def test_play_is_half_the_gap_against_the_approach():
    rng = np.random.default_rng(0)
    bench = draw_bench(rng, Plan(poses=40), arm="cobot5")
    shift = play(bench.session, 2, 1e-3)
    assert shift == pytest.approx(-0.5e-3 * bench.session.approach[:, 2])


def test_rigid_poses_agree_with_pinocchio_on_the_urdf():
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromXML(urdf_text(SEVEN))
    data = model.createData()
    flange = model.getFrameId("flange")
    bench = draw_bench(np.random.default_rng(1), Plan(poses=30), arm="seven14", compliant=False)
    for k, q in enumerate(bench.session.q):
        pin.framesForwardKinematics(model, data, q)
        place = data.oMf[flange]
        assert bench.model.flange_position[k] == pytest.approx(place.translation, abs=1e-12)
        assert bench.model.flange_rotation[k] == pytest.approx(place.rotation, abs=1e-12)


def test_joint_moments_agree_with_pinocchio_gravity_torques():
    pin = pytest.importorskip("pinocchio")
    from benchmarks.blind.measuring import axial_moments
    from benchmarks.blind.moving import pinocchio_arm

    for kind in ARMS.values():
        bench = draw_bench(
            np.random.default_rng(2), Plan(poses=10, pulled=0), arm=kind.name, compliant=False
        )
        session = replace(bench.session, payload_mass=np.zeros(10))
        model, _ = pinocchio_arm(kind.rows, bench.nominal.gravity)
        data = model.createData()
        gravity = [pin.computeGeneralizedGravity(model, data, q).copy() for q in session.q]
        # what holds an arm up is the opposite of what pulls it down
        moments = axial_moments(bench.nominal, session)
        assert moments == pytest.approx(-np.array(gravity), abs=1e-8)
