"""The effects of wrench, tracking and torque: signs, sites, steps either way, order of action."""

from __future__ import annotations

import moving_truth as truth
import numpy as np
import pytest

from gapbridge.core.dynamics import predict_torque, predict_tracking, predict_wrench, with_pieces
from gapbridge.core.effects import CATALOGUE, Site, Term
from gapbridge.core.motion import motion_of

COURSE = truth.course(6, 3)
WRENCH = ("ft_bias", "ft_drift", "ft_gain", "ft_misalignment", "payload")
TRACKING = ("latency", "tracking_lag")
TORQUE = ("coulomb_friction", "viscous_friction", "rotor_inertia", "link_inertia",
          "torque_constant", "payload")  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    model = truth.plant(tmp_path_factory.mktemp("arm"), 6, 1).model(payload=2.0)
    t = np.arange(1500) / 500
    log = truth.log_of(6, timestamp=t, actual_q=COURSE.at(t), target_q=COURSE.at(t))
    return model, with_pieces(model, motion_of(log))


PREDICT = {"wrench": predict_wrench, "tracking": predict_tracking, "torque": predict_torque}


def terms_of(effect, arm, factor):
    member = CATALOGUE[effect]
    return [
        Term(effect, site, tuple(factor * p.scale for p in member.parameters(arm, site)))
        for site in member.sites(arm)
    ]


@pytest.mark.parametrize(
    ("channel", "effect"),
    [(c, e) for c, es in zip(PREDICT, (WRENCH, TRACKING, TORQUE), strict=True) for e in es],
)
def test_small_steps_either_way_are_opposite_and_zero_is_nothing(scene, channel, effect):
    model, motion = scene
    predict = PREDICT[channel]
    nominal = predict(model, motion)
    for up, down, none in zip(*(terms_of(effect, model.arm, f) for f in (0.01, -0.01, 0)),
                              strict=True):  # fmt: skip
        rise, fall = ((predict(model, motion, [t]) - nominal)[5:-5] for t in (up, down))
        assert np.abs(rise).max() > 0
        assert np.abs(rise + fall).max() < 0.05 * np.abs(rise).max()
        assert np.allclose(predict(model, motion, [none]), nominal, rtol=0, atol=1e-12)


@pytest.mark.parametrize("effect", [*TRACKING, "coulomb_friction", "viscous_friction",
                                    "rotor_inertia", "torque_constant"])  # fmt: skip
def test_an_effect_of_one_joint_moves_that_joint_only(scene, effect):
    model, motion = scene
    channel = CATALOGUE[effect].channels[0]
    term = Term(effect, Site(3), (0.02,))
    change = PREDICT[channel](model, motion, [term]) - PREDICT[channel](model, motion)
    assert np.abs(change[:, 2]).max() > 0
    assert not np.delete(change, 2, axis=1).any()


def test_the_encoder_comes_after_the_command(scene):
    model, motion = scene
    moving = np.abs(motion.qd[:, 1]) > 0.3
    for effect in TRACKING:
        late = predict_tracking(model, motion, [Term(effect, Site(2), (0.02,))])[:, 1]
        behind = (motion.target_q[:, 1] - late) * np.sign(motion.qd[:, 1])
        assert np.all(behind[moving][100:] > 0)


def test_latency_and_lag_are_exact(scene):
    model, motion = scene
    settled = motion.t > 0.4
    late = predict_tracking(model, motion, [Term("latency", Site(2), (0.0137,))])
    assert np.abs(late - COURSE.at(motion.t - 0.0137))[settled, 1].max() < 1e-8
    lagged = predict_tracking(model, motion, [Term("tracking_lag", Site(2), (0.03,))])
    exact = COURSE.lagged(motion.t, np.array([0, 0.03, 0, 0, 0, 0]))
    assert np.abs(lagged - exact)[settled, 1].max() < 1e-6


def test_poses_at_rest_know_no_delay(scene):
    model, _ = scene
    q = truth.poses(6, 30, 0)
    motion = motion_of(truth.log_of(6, timestamp=np.arange(30) * 30.0, actual_q=q, target_q=q))
    for effect in TRACKING:
        assert np.array_equal(predict_tracking(model, motion, [Term(effect, Site(1), (1.0,))]), q)


def test_friction_and_rotor_resist_the_motion(scene):
    model, motion = scene
    nominal = predict_torque(model, motion)
    for effect, along in (("coulomb_friction", motion.qd), ("viscous_friction", motion.qd),
                          ("rotor_inertia", motion.qdd)):  # fmt: skip
        more = predict_torque(model, motion, [Term(effect, Site(2), (1.0,))]) - nominal
        assert np.all(more[:, 1] * np.sign(along[:, 1]) >= 0)


def test_the_torque_constant_scales_friction_too(scene):
    model, motion = scene
    friction = Term("viscous_friction", Site(2), (3.0,))
    scaled = Term("torque_constant", Site(2), (0.1,))
    either = [predict_torque(model, motion, ts) for ts in ([friction, scaled], [scaled, friction])]
    assert np.array_equal(*either)
    expected = 1.1 * predict_torque(model, motion, [friction])[:, 1]
    assert np.allclose(either[0][:, 1], expected, atol=1e-12)


def test_the_sensor_turns_then_scales_then_adds(scene):
    model, motion = scene
    w = predict_wrench(model, motion)
    turned = Term("ft_misalignment", Site(), (0.0, 0.0, np.pi / 2))
    gained = Term("ft_gain", Site(), (0.1, 0, 0, 0, 0, 0.2))
    biased = Term("ft_bias", Site(), (1.0, 2.0, 3.0, 0.1, 0.2, 0.3))
    drifts = Term("ft_drift", Site(), (1.0, 0, 0, 0, 0, 0))
    read = predict_wrench(model, motion, [drifts, biased, gained, turned])
    # the sensor's x is the flange's y, its y the flange's -x
    expected = np.column_stack([1.1 * w[:, 1] + 1 + motion.t, -w[:, 0] + 2, w[:, 2] + 3,
                                w[:, 4] + 0.1, -w[:, 3] + 0.2, 1.2 * w[:, 5] + 0.3])  # fmt: skip
    assert np.allclose(read, expected, atol=1e-12)


def test_effects_in_the_cell_and_new_ones_act_together(scene):
    model, motion = scene
    term = Term("payload", Site(), (0.5,))
    inside = model.with_terms([term])
    for predict in (predict_torque, predict_wrench):
        assert np.allclose(predict(inside, motion), predict(model, motion, [term]), atol=1e-12)
        rebuilt = with_pieces(inside, motion)
        assert np.allclose(predict(inside, rebuilt), predict(model, motion, [term]), atol=1e-12)


def test_every_moving_effect_reports_what_it_needs():
    for effect in {*WRENCH, *TRACKING, *TORQUE}:
        member = CATALOGUE[effect]
        assert member.motion
        assert "Source:" in member.__doc__ or effect == "payload"
