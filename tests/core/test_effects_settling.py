"""Servos that rest elsewhere than commanded, and what has slipped: in predictions and setpoints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gapbridge.core.arm import builtin_arm
from gapbridge.core.compensation import Compensator, correct
from gapbridge.core.dynamics import predict_tracking
from gapbridge.core.effects import Site, Term
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.motion import motion_of

DROOP = [
    Term("servo_droop", Site(j + 1), (c,)) for j, c in enumerate([0, 4e-5, 5e-5, 2e-4, 3e-4, 0])
]
BAND = [Term("dead_band", Site(j), (2e-3,)) for j in (2, 4)]
SOFT = Model(builtin_arm("ur10e"), payload_mass=5.0, payload_cog=np.array([0.0, 0.02, 0.1]))
SOFT = SOFT.with_compliance([2e-5] * 6, [1e-5] * 6)


def poses(count: int = 12) -> tuple[np.ndarray, Loads]:
    rng = np.random.default_rng(4)
    q = np.array([0.0, -1.2, 1.5, -1.8, -1.5, 0.0]) + rng.uniform(-0.5, 0.5, (count, 6))
    return q, Loads(approach=rng.choice([-1.0, 1.0], (count, 6)))


def test_what_a_joint_holds_is_the_weight_beyond_it_about_its_axis() -> None:
    model = Model(builtin_arm("ur10e"), payload_mass=5.0)
    q, step = poses(5)[0], 1e-6

    def height(q: np.ndarray) -> np.ndarray:
        """Return the potential energy of links and payload, J."""
        total = np.zeros(len(q))
        for i in range(model.arm.n):
            arm = replace(
                model.arm, link_in_link=np.concatenate([
                    model.arm.link_in_link[: i + 1],
                    np.tile(np.eye(4), (model.arm.n - i, 1, 1)),
                ]),
            )  # fmt: skip
            tool = np.eye(4)
            tool[:3, 3] = model.arm.cog[i]
            still = q.copy()
            still[:, i + 1 :] = 0.0
            at = Model(arm, tool).predict(still).position
            total += 9.80665 * model.arm.mass[i] * at[:, 2]
        return total + 9.80665 * 5.0 * model.predict(q).position[:, 2]

    held = model.holding_torque(q)
    for j in range(6):
        ends = [height(q + s * np.eye(6)[j]) for s in (step, -step)]
        np.testing.assert_allclose(held[:, j], (ends[0] - ends[1]) / (2 * step), atol=1e-5)


@pytest.mark.parametrize("terms", [DROOP, BAND, [*DROOP, *BAND]])
def test_a_corrected_setpoint_brings_the_arm_where_it_was_wanted(terms: list[Term]) -> None:
    real = SOFT.with_terms(terms)
    q, loads = poses()
    wanted = SOFT.rigid_pose(q)
    plain = real.predict(real.settled(correct(SOFT, q, loads).q, loads), loads)
    found = real.predict(real.settled(correct(real, q, loads).q, loads), loads)
    before = np.linalg.norm(plain.position - wanted.position, axis=1)
    after = np.linalg.norm(found.position - wanted.position, axis=1)
    assert before.max() > 2e-3
    assert after.max() < 1e-6


def test_the_correction_of_droop_is_part_of_the_offset_that_is_limited() -> None:
    rigid = Model(SOFT.arm, payload_mass=5.0)
    live, q = Compensator(rigid.with_terms(DROOP)), poses()[0][0]
    found = live.correct(q)
    held = rigid.holding_torque(q[None])[0]
    droop = np.array([0, 4e-5, 5e-5, 2e-4, 3e-4, 0])
    np.testing.assert_allclose(found.q - q, droop * held, rtol=1e-6, atol=1e-12)
    moved = rigid.predict(found.q[None]).position[0] - rigid.predict(q[None]).position[0]
    np.testing.assert_allclose(found.offset_in_base[:3], moved, atol=1e-9)


def test_play_stands_still_inside_its_band_and_is_pushed_at_its_ends() -> None:
    t = np.arange(0, 4, 0.01)
    target = np.zeros((len(t), 6))
    target[:, 1] = 0.1 * np.sin(2 * np.pi * t)
    motion = motion_of(Log("t", {"timestamp": t, "actual_q": target, "target_q": target}, 6))
    moved = predict_tracking(SOFT, motion, [Term("dead_band", Site(2), (0.02,))])[:, 1]
    off = target[:, 1] - moved
    assert np.abs(off).max() <= 0.02 + 1e-12
    rising = (np.gradient(target[:, 1]) > 0) & (target[:, 1] > 0.02) & (t > 1)
    np.testing.assert_allclose(off[rising], 0.02, atol=1e-12)
    assert moved[t > 1].max() == pytest.approx(0.08, abs=1e-4)


@pytest.mark.parametrize(
    "term",
    [Term("joint_slip", Site(3), (0.01, 5.0)),
     Term("target_slip", Site(), (1e-3, -2e-3, 3e-3, 5.0))],
)  # fmt: skip
def test_rows_after_a_slip_take_it_and_live_setpoints_always_do(term: Term) -> None:
    q, loads = poses(10)
    real = SOFT.with_terms([term])
    timed = replace(loads, time=np.arange(10.0) + 0.5)
    before, after = SOFT.predict(q, timed).position, real.predict(q, loads).position
    assert np.linalg.norm(after - before, axis=1).min() > 1e-4
    seen = real.predict(q, timed).position
    np.testing.assert_allclose(seen[:5], before[:5], atol=1e-9)
    np.testing.assert_allclose(seen[5:], after[5:], atol=1e-12)
    np.testing.assert_array_equal(correct(real, q, timed).q, correct(real, q, loads).q)
