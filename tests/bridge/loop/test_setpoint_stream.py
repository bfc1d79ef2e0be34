"""From a nominal setpoint to what may leave: led over, corrected, ramped, limited, braked."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gapbridge.bridge.cell.sections import LimitSettings
from gapbridge.bridge.loop.setpoint_stream import (
    DECELERATION,
    NominalStream,
    SetpointStream,
    limits_of,
)
from gapbridge.core.arm import arm_from_dh, builtin_arm, builtin_rows
from gapbridge.core.compensation import Correction, correct
from gapbridge.core.errors import LimitError, StaleStateError
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import SYSTEM

Q = np.array([0.0, -1.5, 1.8, -1.87, -1.57, 0.0])
CYCLE = 0.002
LIGHT = Loads(payload_mass=np.array([5.0]), payload_cog=np.array([[0.0, 0.0, 0.06]]))


def model(soft: float = 5e-6) -> Model:
    found = Model(builtin_arm("ur10e"), payload_mass=5.0)
    return found.with_compliance(axial=np.full(6, soft), radial=np.full(6, soft / 5))


def state(at: float, q: np.ndarray = Q) -> RobotState:
    return RobotState(at, at, q, np.zeros(6), q, np.zeros(6))


class Run:
    """Drives a stream as the loop does, with an arm that follows at once."""

    def __init__(self, soft: float = 5e-6, start: np.ndarray = Q, **limits: float) -> None:
        self.stream = SetpointStream(model(soft), LimitSettings(**limits), 500.0, clock=SYSTEM)
        self.at, self.q, self.start = 100.0, start.copy(), start
        self.sent: list[Setpoint] = []
        self.stream.start(start, self.at)

    def cycles(
        self, count: int, source: np.ndarray | None = Q, goal: float = 1.0, gap: float = CYCLE
    ) -> Setpoint:
        for _ in range(count):
            found = self.stream.advance(state(self.at, self.q), source, LIGHT, goal)
            self.q = found.q.copy()
            copy = found.offset_in_base.copy()
            self.sent.append(Setpoint(self.q, found.nominal_q.copy(), copy))
            self.at += gap
        return self.sent[-1]

    def steps(self) -> np.ndarray:
        return np.diff([self.start, *(s.q for s in self.sent)], axis=0)


def test_the_offset_ramps_in_to_the_whole_correction_and_out_to_none() -> None:
    run = Run()
    first = run.cycles(1)
    assert np.abs(first.q - Q).max() < 1e-5
    whole = run.cycles(400)
    wanted = correct(model(), Q[None], LIGHT)
    assert whole.q == pytest.approx(wanted.q[0], abs=1e-12)
    assert whole.offset_in_base == pytest.approx(wanted.offset_in_base[0], abs=1e-12)
    assert np.linalg.norm(whole.offset_in_base[:3]) > 3e-4
    lengths = [np.linalg.norm(s.offset_in_base) for s in run.sent]
    assert np.diff(lengths).min() > -1e-9
    end = run.cycles(400, goal=0.0)
    assert end.q == pytest.approx(Q, abs=1e-15)
    assert run.stream.at_rest
    assert np.abs(run.steps()).max() < 1e-4


def test_an_arm_of_five_joints_gets_the_offset_that_it_can_make() -> None:
    arm = arm_from_dh(builtin_rows("ur10e")["dh"][:5])
    five = Model(arm, payload_mass=5.0).with_compliance(np.full(5, 5e-6), np.full(5, 5e-6))
    stream, q = SetpointStream(five, LimitSettings(), 500.0, clock=SYSTEM), Q[:5]
    stream.start(q, 100.0)
    for k in range(400):
        found = stream.advance(
            RobotState(100.0 + k * CYCLE, 0.0, q, np.zeros(5), q, np.zeros(5)), q, LIGHT, 1.0
        )
    assert stream.unsolved == ""
    assert stream.residual > 1e-5
    assert found.q == pytest.approx(correct(five, q[None], LIGHT).q[0], abs=1e-7)
    assert np.abs(found.q - q).max() > 1e-4


def test_a_correction_that_misses_is_not_sent_and_the_last_solved_one_ramps_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = Run()
    last = run.cycles(400).offset_in_base
    missing = Correction(Q + 0.02, np.full(6, 0.005), 1e-3, 3)
    monkeypatch.setattr(run.stream._compensator, "correct", lambda q, loads: missing)
    run.cycles(400, goal=0.0)
    assert "1 mm from the wanted pose" in run.stream.unsolved
    sent = np.array([s.offset_in_base for s in run.sent[400:]])
    share = sent @ last / (last @ last)
    assert sent == pytest.approx(np.outer(share, last), abs=1e-12)
    assert (np.diff(share) <= 1e-12).all()
    assert share[0] > 0.98
    assert run.stream.at_rest


@pytest.mark.parametrize(("ramp_time", "after"), [(2.0, 0.5), (0.3, 0.3)])
def test_a_stop_shortens_a_long_ramp_and_lengthens_none(ramp_time: float, after: float) -> None:
    run = Run(ramp_time=ramp_time)
    run.stream.shorten_ramp(0.5)
    assert run.stream.ramp_time == after


def test_a_first_setpoint_beside_the_arm_is_led_over_to_without_a_jump() -> None:
    run = Run(soft=1e-9)
    beside = Q + np.array([0.019, -0.019, 0.01, 0.0, 0.015, -0.019])
    end = run.cycles(1000, source=beside)
    assert end.nominal_q == pytest.approx(beside, abs=1e-12)
    poses = model().rigid_pose(np.array([sent.q for sent in run.sent]))
    places = np.linalg.norm(np.diff(poses.position, axis=0), axis=1).max() / CYCLE
    turned = np.einsum("nij,nij->n", poses.rotation[1:], poses.rotation[:-1])
    turns = np.arccos(np.minimum(0.5 * (turned - 1.0), 1.0)).max() / CYCLE
    limits = run.stream.limiter.limits  # half of them, as the offset may change meanwhile
    assert 0.4 < max(places / limits.offset_rate, turns / limits.offset_rotation_rate) < 0.55
    assert run.stream.limiter.counts.sum() == 0


def test_a_source_that_dries_up_in_motion_brakes_smoothly_and_comes_to_rest() -> None:
    run = Run(soft=1e-9)
    speed = np.array([0.8, -0.4, 0.2, 0.0, 0.0, 0.1])
    run.cycles(300)
    for k in range(1, 200):
        run.cycles(1, source=Q + speed * k * CYCLE)
    assert not run.stream.at_rest
    run.cycles(400, source=None, goal=0.0)
    assert run.stream.at_rest
    acceleration = np.diff(run.steps(), axis=0)[520:] / CYCLE**2
    assert np.abs(acceleration).max() < 1.2 * DECELERATION
    way = run.sent[-1].q - Q
    assert way == pytest.approx(way[0] / speed[0] * speed, abs=1e-6)


def test_numbers_that_are_not_finite_never_leave() -> None:
    run = Run()
    before = run.cycles(400)
    with pytest.raises(LimitError):
        run.cycles(1, source=np.array([0.0, np.nan, 0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(LimitError):
        run.cycles(1, source=np.full(6, np.inf))
    after = run.cycles(1)
    assert after.q == pytest.approx(before.q, abs=1e-9)


@pytest.mark.parametrize("part", ["q", "offset_in_base"])
def test_a_correction_that_is_no_number_is_known_as_such(
    part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = Run().stream
    fine = stream.correct(Q, LIGHT)
    assert stream.finite
    spoilt = getattr(fine, part).copy()
    spoilt[1] = np.nan
    compensator = stream._compensator
    monkeypatch.setattr(compensator, "correct", lambda *_: fine._replace(**{part: spoilt}))
    stream.correct(Q, LIGHT)
    assert not stream.finite


def test_a_jump_of_the_source_is_refused() -> None:
    run = Run()
    run.cycles(400)
    with pytest.raises(LimitError, match="joint 2 jumps"):
        run.cycles(1, source=Q + np.array([0, 0.2, 0, 0, 0, 0]))


def test_a_clock_that_stands_still_is_refused() -> None:
    run = Run()
    run.cycles(10)
    run.at -= CYCLE
    with pytest.raises(LimitError, match="gap"):
        run.cycles(1)


def test_the_envelope_holds_back_what_a_wrong_model_wants() -> None:
    run = Run(soft=2e-4, offset=0.002)
    end = run.cycles(500)
    assert np.linalg.norm(end.offset_in_base[:3]) == pytest.approx(0.002, rel=1e-6)
    assert run.stream.clamped
    lengths = [np.linalg.norm(s.offset_in_base[:3]) for s in run.sent]
    assert np.diff(lengths, prepend=0).max() <= 0.05 * CYCLE * 1.0001


def test_limits_come_from_the_arm_and_the_cell() -> None:
    arm = builtin_arm("ur10e")
    limits = limits_of(LimitSettings(joint_margin=0.1, joint_velocity=1.0), arm, 250.0)
    assert limits.lower == pytest.approx(arm.limits.lower + 0.1)
    assert limits.upper == pytest.approx(arm.limits.upper - 0.1)
    assert limits.velocity == pytest.approx(np.minimum(arm.limits.velocity, 1.0))
    assert limits.cycle == pytest.approx(0.004)


def test_braking_keeps_the_direction_and_ends_after_the_right_way() -> None:
    speed = np.array([1.0, -0.5])
    stream = NominalStream(np.full(2, 3.0), np.full(2, -3.0), np.full(2, 3.0))
    stream.start(np.zeros(2))
    for k in range(1, 200):
        stream.follow(speed * k * CYCLE, CYCLE)
    begin = stream.q.copy()
    while not stream.at_rest:
        stream.brake(CYCLE)
    way = stream.q - begin
    assert way[0] == pytest.approx(1.0 / (2 * DECELERATION), rel=0.03)
    assert way[1] == pytest.approx(-0.5 * way[0], rel=1e-6)
    assert stream.brake(CYCLE) == pytest.approx(stream.q)


@pytest.mark.parametrize("room", [0.3, 0.1, 0.05, 0.02, 0.004])
@pytest.mark.parametrize("ways", [1.0, -1.0])
def test_a_motion_that_ends_before_a_joint_limit_brakes_hard_enough_to_stop_there(
    room: float, ways: float
) -> None:
    speed = 1.6 * ways * np.array([0.2, 0.0, 1.0, 0.0, -0.1, 0.0])  # joint 3 towards its limit
    limits = builtin_arm("ur10e").limits
    limit = limits.upper[2] if ways > 0.0 else limits.lower[2]
    q = Q.copy()
    q[2] = limit - ways * room - 1.2 * speed[2]
    run = Run(soft=1e-9, start=q)
    run.cycles(300, source=q)
    for k in range(1, 601):
        run.cycles(1, source=q + speed * CYCLE * k)
    assert ways * (limit - run.q[2]) == pytest.approx(room, abs=1e-6)
    run.cycles(1000, source=None, goal=0.0)
    assert run.stream.at_rest
    assert ways * (limit - run.q[2]) >= 0.0
    steps = np.diff([s.nominal_q for s in run.sent[899:]], axis=0) / CYCLE
    assert (np.abs(steps) <= np.abs(speed) * (1.0 + 1e-6) + 1e-9).all()
    harder = max(DECELERATION, speed[2] ** 2 / (2.0 * room))
    assert np.abs(np.diff(steps[:, 2])).max() <= 1.2 * harder * CYCLE


FAST = np.array([0.35, 0.0, 0.0, 0.0, 0.0, 0.0])  # rad/s


def driven(run: Run, seconds: float) -> None:
    """Move the source at FAST."""
    for k in range(round(seconds / CYCLE)):
        run.cycles(1, source=Q + FAST * CYCLE * (k + 1))


def test_setpoints_faster_than_the_limit_are_refused_before_the_command_lags_far() -> None:
    run = Run(joint_velocity=0.2)
    with pytest.raises(LimitError, match=r"joint 1 would be more than 0\.1 rad behind its nominal"):
        driven(run, 2.0)
    assert run.sent[-1].nominal_q[0] - run.q[0] == pytest.approx(0.1, abs=2e-3)


def test_a_command_that_lags_brakes_where_it_is() -> None:
    run = Run(joint_velocity=0.2, following=0.5)
    driven(run, 2.0)
    assert not run.stream.arrived
    lag, at = run.stream.limiter.lag, run.q[0]
    assert lag == pytest.approx(0.3, rel=0.1)
    run.cycles(40, source=None)
    assert run.q[0] - at < 0.2**2 / (2 * DECELERATION) + 1e-3  # not on to the last nominal setpoint
    speeds = run.steps()[-40:, 0] / CYCLE
    assert np.abs(np.diff(speeds)).max() <= 1.5 * DECELERATION * CYCLE
    assert speeds[-1] == pytest.approx(0.0, abs=1e-3)
    run.cycles(400, source=None, goal=0.0)
    assert run.stream.at_rest


def test_a_command_that_lags_has_not_arrived_until_it_is_there() -> None:
    run = Run(joint_velocity=0.2)
    driven(run, 0.3)
    end = Q + FAST * 0.3
    run.cycles(5, source=end)
    assert not run.stream.arrived
    run.cycles(400, source=end)
    assert run.stream.arrived


def test_what_is_refused_changes_nothing() -> None:
    """A braking motion would otherwise be ahead of its command."""
    run = Run()
    for k in range(100):
        run.cycles(1, Q + 0.001 * k)
    held = run.stream._nominal._motion.copy(), run.stream.limiter._block.copy(), run.stream._last
    moment = state(run.at, run.q)
    with pytest.raises(StaleStateError):
        run.stream.advance(moment, None, LIGHT, 0.0, expiry=-1.0)
    with pytest.raises(LimitError):
        run.stream.advance(state(run.at, run.q + 1.0), None, LIGHT, 0.0)
    run.stream.advance(moment, None, LIGHT, 0.0)
    run.stream.take_back()
    assert (run.stream._nominal._motion == held[0]).all()
    assert (run.stream.limiter._block == held[1]).all()
    assert run.stream._last == held[2]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from([0.0, 1.0]), st.booleans(), st.integers(1, 12)),
        min_size=2, max_size=25,
    )
)  # fmt: skip
def test_no_step_between_setpoints_in_force_is_longer_than_five_cycles_allow(
    cycles: list[tuple[float, bool, int]],
) -> None:
    """Whatever is refused or lapses in between: goal of the ramp, in force, cycles since."""
    run = Run(soft=5e-5, offset_rate=1e-3)
    in_force, gap = np.zeros(6), 0
    for goal, effective, waited in cycles:
        run.at += (waited - 1) * CYCLE
        gap += waited
        found = run.cycles(1, goal=goal).offset_in_base
        if not effective:
            run.stream.take_back()
            continue
        step = float(np.linalg.norm((found - in_force)[:3]))
        assert step <= 1e-3 * CYCLE * min(gap, 5) * (1.0 + 1e-9)
        in_force, gap = found, 0
