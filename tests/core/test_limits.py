from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from gapbridge.core.errors import LimitError
from gapbridge.core.limits import (
    MAX_JOINT_OFFSET,
    MAX_OFFSET,
    MAX_OFFSET_ROTATION,
    Limiter,
    Limits,
)
from gapbridge.core.state import CLAMPS, ENVELOPE, JOINT_LIMIT, JOINT_OFFSET, RATE, VELOCITY

Array = NDArray[np.float64]
N = 6
DT = 0.002
TINY = 1.0 + 1e-9


def limits(**changed: Any) -> Limits:
    found = Limits(np.full(N, -2.0), np.full(N, 2.0), np.full(N, 1.5), cycle=DT)
    return replace(found, **changed)


def run(limiter: Limiter, q: Array, delta: Array, offset: Array, ramp: float = 1.0,
        cycles: int = 1) -> tuple[Array, Array]:  # fmt: skip
    for _ in range(cycles):
        out = limiter.limit(q, q + delta, offset, ramp, q, DT)
    return out.q.copy(), out.offset_in_base.copy()


def started(q: Array, **changed: Any) -> Limiter:
    limiter = Limiter(limits(**changed), N)
    limiter.start(q)
    return limiter


anything = st.floats(allow_nan=True, allow_infinity=True, width=64)
joints = st.lists(st.floats(-3.0, 3.0), min_size=N, max_size=N).map(np.array)
corrections = st.lists(st.floats(-0.3, 0.3), min_size=N, max_size=N).map(np.array)
offsets = st.lists(st.floats(-0.1, 0.1), min_size=6, max_size=6).map(np.array)
cycle = st.tuples(joints, corrections, offsets, st.floats(-0.5, 1.5), st.floats(1e-4, 0.1))
outlier = st.tuples(
    st.lists(anything, min_size=N, max_size=N).map(np.array),
    st.lists(anything, min_size=N, max_size=N).map(np.array),
    st.lists(anything, min_size=6, max_size=6).map(np.array),
    anything,
    anything,
)


def assert_allowed(limiter: Limiter, before: tuple[Array, Array], dt: float) -> None:
    """What holds for every setpoint that leaves, whatever came in."""
    own = limiter.limits
    q, offset = limiter._q, limiter._offset
    gap = min(dt, 5 * own.cycle)
    assert np.isfinite(q).all()
    assert np.isfinite(offset).all()
    assert np.linalg.norm(offset[:3]) <= own.offset * TINY
    assert np.linalg.norm(offset[3:]) <= own.offset_rotation * TINY
    assert (q >= own.lower).all()
    assert (q <= own.upper).all()
    assert (np.abs(q - before[0]) <= own.velocity * gap * TINY + 1e-15).all()
    change = offset - before[1]
    assert np.linalg.norm(change[:3]) <= own.offset_rate * gap * TINY + 1e-15
    assert np.linalg.norm(change[3:]) <= own.offset_rotation_rate * gap * TINY + 1e-15
    assert (np.abs(limiter._delta) <= own.joint_offset * TINY).all()


@pytest.mark.slow
@settings(max_examples=300, deadline=None)
@given(st.lists(cycle, min_size=1, max_size=15))
def test_nothing_leaves_that_is_outside_envelope_rates_or_joint_limits(rows: list[Any]) -> None:
    limiter = started(np.zeros(N), following=10.0)
    for q, delta, offset, ramp, dt in rows:
        before = limiter._q.copy(), limiter._offset.copy()
        try:
            limiter.limit(q, q + delta, offset, ramp, q, dt)
        except LimitError:
            assert (limiter._q == before[0]).all()
            assert (limiter._offset == before[1]).all()
            continue
        assert_allowed(limiter, before, dt)


@pytest.mark.parametrize("first", [0, 3])
@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8)])
def test_a_lasting_offset_comes_to_its_envelope_and_no_farther(
    first: int, direction: tuple[float, float, float]
) -> None:
    limiter = started(np.zeros(N))
    most = limiter.limits.offset if first == 0 else limiter.limits.offset_rotation
    offset = np.zeros(6)
    offset[first : first + 3] = 5.0 * most * np.array(direction)
    _, out = run(limiter, np.zeros(N), np.zeros(N), offset, cycles=2000)
    expected = np.zeros(6)
    expected[first : first + 3] = most * np.array(direction)
    np.testing.assert_allclose(out, expected, rtol=1e-6, atol=1e-12)
    assert np.linalg.norm(out) <= most


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_offset_that_grows_along_the_motion_makes_no_joint_faster(sign: float) -> None:
    """The command falls behind the correction, and is no faster either where it comes up again."""
    limiter = started(np.zeros(N), offset_rate=1.0, velocity=np.full(N, 0.3), following=1.0)
    nominal, before = np.zeros(N), np.zeros(N)
    for _ in range(300):
        nominal = nominal + sign * 0.15 * DT
        out = limiter.limit(
            nominal, nominal + sign * 0.04, np.full(6, 1e-4), 1.0, limiter._q.copy(), DT
        )
        assert np.abs(out.q - before).max() <= 0.3 * DT * TINY
        before = out.q.copy()
    assert limiter.counts[VELOCITY] > 50
    assert limiter.lag < 1e-12


def test_an_offset_that_cannot_fade_in_time_does_not_lead_out_of_the_joint_limits() -> None:
    limiter = Limiter(limits(offset_rate=1e-6, following=1.0), N)
    nominal, delta = np.full(N, 1.95), np.full(N, 0.04)
    limiter.start(nominal + delta, delta, np.array([0.004, 0.0, 0.0, 0.0, 0.0, 0.0]))
    for _ in range(100):
        nominal = np.minimum(nominal + 0.001, 2.0)
        out = limiter.limit(nominal, nominal, np.zeros(6), 1.0, nominal, DT)
        assert (out.q <= 2.0).all()
        assert out.offset_in_base[0] > 0.0039  # the offset itself still fades at its rate
    assert (out.q == 2.0).all()
    assert out.clamped


@settings(max_examples=300, deadline=None)
@given(st.lists(outlier, min_size=1, max_size=6))
def test_no_nan_no_infinity_and_no_huge_number_ever_leaves(rows: list[Any]) -> None:
    limiter = started(np.zeros(N))
    for q, corrected, offset, ramp, dt in rows:
        before = limiter._q.copy(), limiter._offset.copy()
        try:
            limiter.limit(q, corrected, offset, ramp, np.zeros(N), dt)
        except LimitError:
            continue
        assert np.isfinite([*q, *corrected, *offset, ramp, dt]).all()
        assert_allowed(limiter, before, dt)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e9])
@pytest.mark.parametrize("where", range(5))
def test_each_argument_is_refused_when_it_is_not_a_plausible_number(bad: float, where: int) -> None:
    limiter = started(np.zeros(N))
    arguments: list[Any] = [np.zeros(N), np.zeros(N), np.zeros(6), 1.0, np.zeros(N), DT]
    if where == 3:
        arguments[3] = bad if bad != 1e9 else np.nan
    else:
        arguments[where] = arguments[where].copy()
        arguments[where][2] = bad
    with pytest.raises(LimitError, match="not finite"):
        limiter.limit(*arguments)


@settings(max_examples=100, deadline=None)
@given(corrections, offsets)
def test_a_ramp_of_zero_from_the_start_lets_no_offset_out(delta: Array, offset: Array) -> None:
    q = np.full(N, 0.3)
    out_q, out_offset = run(started(q), q, delta, offset, ramp=0.0, cycles=5)
    assert (out_q == q).all()
    assert (out_offset == 0.0).all()


def test_a_ramp_of_zero_brings_an_offset_to_exactly_zero_without_a_jump() -> None:
    q, delta, offset = np.zeros(N), np.full(N, 0.004), np.array([4e-3, 0, 0, 0, 2e-3, 0])
    limiter = started(q)
    run(limiter, q, delta, offset, cycles=100)
    lengths = []
    for _ in range(60):
        _, now = run(limiter, q, delta, offset, ramp=0.0)
        lengths.append(np.linalg.norm(now[:3]))
    assert (np.diff(lengths) <= 0.0).all()
    assert (np.diff(lengths) >= -0.05 * DT * TINY).all()
    assert lengths[-1] == 0.0
    assert (limiter._q == q).all()


def test_a_small_correction_passes_unchanged() -> None:
    q, delta, offset = np.full(N, 0.5), np.full(N, 1e-3), np.array([1e-3, -1e-3, 0, 1e-3, 0, 0])
    limiter = started(q)
    out_q, out_offset = run(limiter, q, delta, offset, cycles=100)
    assert out_q == pytest.approx(q + delta, abs=1e-15)
    assert out_offset == pytest.approx(offset, abs=1e-15)
    before = limiter.counts.copy()
    run(limiter, q, delta, offset)
    assert (limiter.counts == before).all()


def test_a_long_correction_is_shortened_in_its_own_direction() -> None:
    q = np.zeros(N)
    delta = np.array([0.01, -0.02, 0.03, 0.0, 0.01, 0.02])
    offset = np.array([0.03, 0.0, 0.04, 0.001, 0.002, 0.0])
    limiter = started(q)
    out_q, out_offset = run(limiter, q, delta, offset, cycles=500)
    assert np.linalg.norm(out_offset[:3]) == pytest.approx(0.010)
    assert out_offset == pytest.approx(0.2 * offset)
    assert out_q == pytest.approx(0.2 * delta)
    assert limiter.counts[ENVELOPE] == 500


def test_a_joint_correction_without_a_tcp_offset_is_bounded_too() -> None:
    q, delta = np.zeros(N), np.array([0.2, -0.1, 0.0, 0.0, 0.0, 0.0])
    limiter = started(q)
    out_q, _ = run(limiter, q, delta, np.zeros(6), cycles=200)
    assert out_q == pytest.approx(0.25 * delta)
    assert limiter.counts[JOINT_OFFSET] == 200


def test_the_offset_grows_at_its_rate_and_says_so() -> None:
    q, offset = np.zeros(N), np.array([5e-3, 0, 0, 0, 0, 0])
    limiter = started(q)
    lengths = [run(limiter, q, np.full(N, 1e-3), offset)[1][0] for _ in range(60)]
    assert np.diff([0.0, *lengths[:49]]) == pytest.approx(np.full(49, 0.05 * DT))
    assert lengths[-1] == pytest.approx(5e-3)
    assert limiter.counts[RATE] >= 49


def test_rotation_has_a_rate_of_its_own() -> None:
    limiter = started(np.zeros(N))
    _, offset = run(limiter, np.zeros(N), np.zeros(N), np.array([0, 0, 0, 0, 0.01, 0]))
    assert offset[4] == pytest.approx(0.1 * DT)


def test_near_a_joint_limit_the_correction_shrinks_as_a_whole() -> None:
    q = np.array([1.999, 0.0, 0.0, 0.0, 0.0, 0.0])
    delta = np.array([0.004, 0.008, 0.0, 0.0, 0.0, 0.0])
    offset = np.array([4e-3, 0, 0, 0, 0, 0])
    limiter = started(q)
    out_q, out_offset = run(limiter, q, delta, offset, cycles=100)
    assert out_q == pytest.approx(q + 0.25 * delta)
    assert out_offset == pytest.approx(0.25 * offset)
    assert limiter.counts[JOINT_LIMIT] > 0


def test_a_nominal_setpoint_outside_the_joint_limits_is_refused_by_joint() -> None:
    q = np.array([0.0, 0.0, 1.999, 0.0, 0.0, 0.0])
    limiter = started(q)
    with pytest.raises(LimitError, match=r"joint 3: found 2\.0010 rad"):
        limiter.limit(q + 0.002 * (q > 0), q, np.zeros(6), 1.0, q, DT)


def test_a_fast_nominal_is_followed_no_faster_than_the_joint_may() -> None:
    limiter = started(np.zeros(N))
    nominal, seen = np.zeros(N), []
    for _ in range(20):
        nominal = nominal + 2.0 * DT  # 2 rad/s where 1.5 is allowed
        seen.append(limiter.limit(nominal, nominal, np.zeros(6), 1.0, nominal, DT).q[0])
    assert np.diff(seen) == pytest.approx(np.full(19, 1.5 * DT))
    for _ in range(20):
        out = limiter.limit(nominal, nominal, np.zeros(6), 1.0, nominal, DT)
    assert out.q == pytest.approx(nominal)


def test_a_nominal_that_jumps_is_refused_and_nothing_moves() -> None:
    limiter = started(np.zeros(N))
    jumped = np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0])
    with pytest.raises(LimitError, match=r"joint 2 jumps by \+0\.1000 rad"):
        limiter.limit(jumped, jumped, np.zeros(6), 1.0, np.zeros(N), DT)
    assert (limiter._q == 0.0).all()


def test_a_command_far_from_the_actual_joints_is_refused() -> None:
    limiter = started(np.zeros(N))
    actual = np.array([0.0, 0.0, 0.0, 0.0, 0.4, 0.0])
    with pytest.raises(LimitError, match=r"joint 5 is 0\.4000 rad behind its last command"):
        limiter.limit(np.zeros(N), np.zeros(N), np.zeros(6), 1.0, actual, DT)


def test_a_step_that_would_leave_the_arm_too_far_behind_names_its_joint() -> None:
    limiter = started(np.zeros(N))
    actual = np.array([-0.06, 0.0, 0.0, -0.099, 0.0, 0.0])  # each within 0.1 of the last command
    goal = np.array([0.0, 0.0, 0.0, 1.5 * DT, 0.0, 0.0])
    expected = r"joint 4 is 0\.0990 rad behind its last command, and would be more than 0\.1 rad"
    with pytest.raises(LimitError, match=expected):
        limiter.limit(goal, goal, np.zeros(6), 1.0, actual, DT)


def test_a_long_gap_does_not_allow_a_long_step() -> None:
    limiter = started(np.zeros(N))
    out = limiter.limit(np.full(N, 0.1), np.full(N, 0.1), np.zeros(6), 1.0, np.zeros(N), 2.0)
    assert out.q == pytest.approx(np.full(N, 5 * DT * 1.5))


@pytest.mark.parametrize("dt", [0.0, -0.002])
def test_a_clock_that_does_not_advance_is_refused(dt: float) -> None:
    with pytest.raises(LimitError, match="gap"):
        started(np.zeros(N)).limit(np.zeros(N), np.zeros(N), np.zeros(6), 1.0, np.zeros(N), dt)


def test_without_a_start_nothing_leaves() -> None:
    limiter = Limiter(limits(), N)
    with pytest.raises(LimitError, match="start"):
        limiter.limit(np.zeros(N), np.zeros(N), np.zeros(6), 1.0, np.zeros(N), DT)
    limiter.start(np.zeros(N))
    assert limiter.started
    limiter.reset()
    assert not limiter.started
    with pytest.raises(LimitError):
        limiter.limit(np.zeros(N), np.zeros(N), np.zeros(6), 1.0, np.zeros(N), DT)


@pytest.mark.parametrize(
    ("delta", "offset"),
    [
        (None, np.full(6, np.nan)),
        (None, np.array([np.inf, 0, 0, 0, 0, 0])),
        (np.full(N, np.nan), None),
        (np.full(N, 0.6), None),
        (None, np.array([0.08, 0.08, 0, 0, 0, 0])),
        (None, np.array([0, 0, 0, 0.4, 0.4, 0])),
    ],
)
def test_no_stream_starts_with_an_offset_that_no_arm_can_have(delta, offset) -> None:
    limiter = Limiter(limits(), N)
    limiter.start(np.zeros(N))
    before = limiter._state.copy()
    with pytest.raises(LimitError, match="start: "):
        limiter.start(np.full(N, 0.1), delta, offset)
    np.testing.assert_array_equal(limiter._state, before)


def test_the_largest_offsets_at_a_start_are_the_largest_that_cells_allow() -> None:
    from gapbridge.bridge.cell.sections import LimitSettings
    from gapbridge.drivers import gate

    most = (MAX_OFFSET, MAX_OFFSET_ROTATION, MAX_JOINT_OFFSET)
    names = ("offset", "offset_rotation", "joint_offset")
    schema = LimitSettings.model_json_schema()["properties"]
    assert tuple(schema[name]["maximum"] for name in names) == most
    assert most[:2] == (gate.MAX_OFFSET, gate.MAX_OFFSET_ROTATION)


@pytest.mark.parametrize("goal", [0.0, 1.0])
def test_an_offset_left_under_a_wider_envelope_comes_inside_at_its_rate(goal: float) -> None:
    """The first setpoint is where the arm is: neither refused, nor a jump into the envelope."""
    left, nominal = np.array([0.03, 0.0, 0.0, 0.0, 0.05, 0.0]), np.full(N, 0.2)
    delta = np.full(N, 0.08)
    limiter = Limiter(limits(offset=0.01, offset_rotation=0.02, joint_offset=0.05), N)
    limiter.start(nominal + delta, delta, left)
    q, offset = nominal + delta, left
    for _ in range(int(1.0 / DT)):
        out = limiter.limit(nominal, nominal + delta, left, goal, q, DT)
        step = out.offset_in_base - offset
        assert np.linalg.norm(step[:3]) <= 0.05 * DT * TINY
        assert np.linalg.norm(step[3:]) <= 0.1 * DT * TINY
        assert np.linalg.norm(out.offset_in_base[:3]) <= np.linalg.norm(offset[:3]) * TINY
        assert np.linalg.norm(out.offset_in_base[3:]) <= np.linalg.norm(offset[3:]) * TINY
        assert np.abs(out.q - q).max() <= 1.5 * DT * TINY
        q, offset = out.q.copy(), out.offset_in_base.copy()
    assert np.linalg.norm(offset[:3]) <= 0.01 * TINY
    assert np.linalg.norm(offset[3:]) <= 0.02 * TINY
    assert np.abs(q - nominal).max() <= 0.05 * TINY
    assert offset.any() == (goal > 0.0)


@pytest.mark.parametrize("q", [np.full(N, np.nan), np.full(N, 2.5)])
def test_a_stream_cannot_start_where_the_arm_must_not_be(q: Array) -> None:
    with pytest.raises(LimitError):
        Limiter(limits(), N).start(q)


@pytest.mark.parametrize(
    ("changed", "output"),
    [
        ({"offset": np.nan}, "offset"),
        ({"offset_rate": 0.0}, "offset_rate"),
        ({"velocity": np.zeros(N)}, "velocity"),
        ({"lower": np.full(N, 3.0)}, "lower joint limit"),
    ],
)
def test_limits_that_make_no_sense_are_refused(changed: dict[str, Any], output: str) -> None:
    with pytest.raises(LimitError, match=output):
        limits(**changed)


def test_limits_of_another_arm_are_refused() -> None:
    with pytest.raises(LimitError, match="shape"):
        Limiter(limits(), 7)


def test_every_clamp_has_a_name_and_a_count() -> None:
    assert len(CLAMPS) == len(set(CLAMPS)) == len(Limiter(limits(), N).counts)
