"""Parts of the loop by themselves: loads of a state, the controller's clock, shared memory."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np
import pytest
from clock_by_hand import ByHand

from gapbridge.bridge.ipc.shared_memory import ROWS, Phase, RunMemory, SharedMemory, write_cycle
from gapbridge.bridge.loop.link_monitor import DRIFT, GROWTH, ControllerClock
from gapbridge.bridge.loop.live_loads import LiveLoads
from gapbridge.core.load_bounds import LoadBounds
from gapbridge.core.state import RobotState
from gapbridge.drivers.clock import SYSTEM

Q = np.array([0.0, -1.5, 1.8])


def state(at: float, received: float = 0.0, q: np.ndarray = Q, **more: object) -> RobotState:
    given = {"actual_TCP_force": np.zeros(6)} | more
    return RobotState(at, received, q, np.zeros(3), q, **given)  # type: ignore[arg-type]


def test_the_first_force_counts_at_once_and_later_ones_come_slowly() -> None:
    loads = LiveLoads(3, use_force=True, time_constant=0.05)
    pull = np.array([10.0, 0, 0, 0, 0, 0])
    assert loads.update(state(1.0, actual_TCP_force=pull)).wrench[0] == pytest.approx(pull)
    after = loads.update(state(1.05, actual_TCP_force=0 * pull)).wrench[0, 0]
    assert after == pytest.approx(10 / np.e)


def test_force_is_left_out_where_the_cell_says_so() -> None:
    loads = LiveLoads(3, use_force=False, time_constant=0.0)
    assert loads.update(state(1.0, actual_TCP_force=np.ones(6))).wrench is None


def test_the_controllers_payload_stands_instead_of_the_models() -> None:
    loads = LiveLoads(3, True, 0.0)
    assert loads.update(state(1.0)).payload_mass is None
    found = loads.update(state(1.1, payload=4.0, payload_cog=np.array([0, 0, 0.1])))
    assert found.payload_mass == pytest.approx([4.0])
    assert found.payload_cog == pytest.approx(np.array([[0, 0, 0.1]]))
    assert loads.update(state(1.2, payload=4.0)).payload_mass is None


def test_a_load_beyond_the_arms_bounds_is_not_taken_and_the_last_one_stays() -> None:
    loads = LiveLoads(3, True, 0.0, LoadBounds(5.0))
    cog = np.array([0, 0, 0.1])
    pull = np.array([0.0, 0, -30, 0, 0, 0])
    for at, mass, force, expected in (
        (1.0, 4.0, pull, None),
        (1.1, 400.0, pull, "payload: found 400 kg"),
        (1.2, 4.0, 300 * pull, "force: found 9000 N"),
        (1.3, 40.0, 300 * pull, "payload"),
        (1.4, 4.0, pull, None),
    ):
        found = loads.update(state(at, payload=mass, payload_cog=cog, actual_TCP_force=force))
        assert found.payload_mass == pytest.approx([4.0])
        assert found.wrench[0] == pytest.approx(pull)
        assert (loads.problem is None) == (expected is None)
        assert (expected or "") in (loads.problem or "")


def test_a_first_payload_that_cannot_be_leaves_the_models_own() -> None:
    loads = LiveLoads(3, True, 0.0, LoadBounds(5.0))
    assert loads.update(state(1.0, payload=40.0, payload_cog=Q * 0)).payload_mass is None


def test_a_lost_sensor_beside_the_controllers_own_force_rejects_nothing_less() -> None:
    loads = LiveLoads(3, True, 0.0, LoadBounds(5.0))
    pull = np.array([0.0, 0, -30, 0, 0, 0])
    loads.update(state(1.0, actual_TCP_force=pull))
    found = loads.update(state(1.1, actual_TCP_force=300 * pull, sensor_lost="silent"))
    assert found.wrench[0] == pytest.approx(pull)
    assert "force: found 9000 N" in (loads.problem or "")
    lost = loads.update(state(1.2, actual_TCP_force=np.full(6, np.nan), sensor_lost="silent"))
    assert loads.problem is None
    assert not lost.wrench.any()


def test_a_force_that_does_not_count_is_not_rejected() -> None:
    loads = LiveLoads(3, False, 0.0, LoadBounds(5.0))
    loads.update(state(1.0, actual_TCP_force=np.full(6, 9e3)))
    assert loads.problem is None


@pytest.mark.parametrize("ways", [1, -1])
def test_a_weight_that_the_controller_subtracts_from_now_on_is_out_of_the_force_at_once(
    ways: int,
) -> None:
    """Else the model bends under the load twice, or not at all, until the filter has followed."""
    loads, mass, cog = LiveLoads(3, True, 0.05), 8.0, np.array([0, 0, 0.1])
    pull = np.array([0.0, 0, -9.81 * mass, 0, 0, 0])
    for k in range(200):
        declared = (k >= 100) == (ways > 0)
        found = loads.update(
            state(
                1 + 0.002 * k,
                actual_TCP_force=0.0 * pull if declared else pull,
                payload=mass if declared else 0.0,
                payload_cog=cog if declared else 0.0 * cog,
            )
        )
        assert found.wrench is not None and found.payload_mass is not None
        weight = 9.81 * float(found.payload_mass[0])
        assert weight - found.wrench[0, 2] == pytest.approx(9.81 * mass)
    payload = {"payload": found.payload_mass[0], "payload_cog": found.payload_cog[0].copy()}  # type: ignore[index]
    after = loads.update(state(1.45, actual_TCP_force=2 * pull, **payload)).wrench
    assert after is not None
    assert after[0, 2] > 1.7 * pull[2]  # a force without a change of the payload is filtered


def test_approach_is_the_last_motion_and_noise_of_encoders_is_none() -> None:
    """Of a link without targets: a count of coarse encoders is 1.5 mrad."""
    loads = LiveLoads(3, True, 0.0)
    way = np.array([5e-4, -5e-4, 0.0])
    noise = 1.5e-3 * np.random.default_rng(0).integers(0, 2, (200, 3))

    def seen(at: float, q: np.ndarray) -> np.ndarray:
        found = loads.update(state(at, q=q), q.copy()).approach
        assert found is not None
        return found[0].copy()

    for k in range(200):
        assert not seen(0.002 * k, Q + noise[k]).any()
    for k in range(200):
        found = seen(1 + 0.002 * k, Q + k * way)
    assert found == pytest.approx([1, -1, 0])
    for k in range(200):
        assert seen(2 + 0.002 * k, Q + 200 * way + noise[k]) == pytest.approx([1, -1, 0])
    for k in range(10):
        found = seen(3 + 0.002 * k, Q + (200 - k) * way)
    assert found == pytest.approx([-1, 1, 0])


@pytest.mark.parametrize("writing", [False, True])
def test_a_commanded_reversal_counts_at_once_and_noise_of_the_encoders_never(writing: bool) -> None:
    loads, speed = LiveLoads(3, True, 0.0), np.array([0.02, -0.02, 0.0])
    noise = np.random.default_rng(1).normal(0, 2.5e-5, (400, 3))
    given = np.concatenate([np.arange(100), np.full(100, 99), np.arange(99, 0, -1), np.zeros(100)])
    signs = []
    for k, way in enumerate(given):
        q, read = Q + 0.002 * way * speed, state(0.002 * k, q=Q + noise[k % 400])
        found = loads.update(read, Q, q) if writing else loads.update(read, q)
        signs.append(found.approach[0].copy())  # type: ignore[index]
    assert np.array(signs[1:200]) == pytest.approx(np.tile([1, -1, 0], (199, 1)))
    assert np.array(signs[201:]) == pytest.approx(np.tile([-1, 1, 0], (len(signs) - 201, 1)))


def test_our_offset_in_the_robots_target_is_no_motion() -> None:
    """Between the robot's own target and the nominal joints of setpoints lies that offset."""
    loads, offset = LiveLoads(3, True, 0.0), np.array([1e-3, -1e-3, 1e-3])
    for k, (own, sent) in enumerate(
        [(Q, None), (Q + offset, Q), (Q + offset, Q), (Q + offset, None)]
    ):
        found = loads.update(state(0.002 * k, q=Q + 5e-5 * k), own, sent)
        assert not found.approach.any()  # type: ignore[union-attr]


def test_temperatures_are_passed_on() -> None:
    loads = LiveLoads(3, True, 0.0)
    assert loads.update(state(1.0)).temperature is None
    warm = np.array([30.0, 31, 32])
    assert loads.update(state(1.1, joint_temperatures=warm)).temperature[0] == pytest.approx(warm)


def test_missed_cycles_are_counted_by_the_controllers_clock() -> None:
    clock = ControllerClock(500.0, clock=SYSTEM)
    missed = [clock.take(state(t)) for t in (1.0, 1.002, 1.004, 1.010, 1.012)]
    assert missed == [0, 0, 0, 2, 0]
    clock.skip()
    assert clock.take(state(3.0)) == 0
    assert clock.take(state(3.004)) == 1


def test_age_counts_from_when_the_sample_could_have_been_here() -> None:
    clock = ControllerClock(500.0, clock=SYSTEM)
    now = time.monotonic()
    clock.take(state(1.0, now))
    clock.take(state(1.002, now + 0.002))
    late = state(1.004, now + 0.004 + 0.0015)
    clock.take(late)
    before = time.monotonic()
    age = clock.age(late)
    assert before - now - 0.004 - 3e-5 <= age <= time.monotonic() - now - 0.004 + 1e-6


def test_a_clock_that_drifts_is_followed() -> None:
    clock = ControllerClock(500.0, clock=SYSTEM)
    for k in range(100_000):
        clock.take(state(0.002 * k, 0.002 * k * (1 + 5e-5)))
    last = state(0.002 * 99_999, 0.002 * 99_999 * (1 + 5e-5))
    before = time.monotonic()
    age = clock.age(last)
    assert before - last.received - 1e-9 <= age <= time.monotonic() - last.received + 1e-4


def test_a_break_does_not_make_the_state_after_it_younger() -> None:
    clock = ControllerClock(500.0, hold=0.04, clock=SYSTEM)
    clock.take(state(1.0, 10.0), transit_known=True)
    after = state(1.6, 10.6 + 0.041)  # 41 ms old when it came to be read
    clock.take(after, transit_known=True)
    assert clock.expiry(after) == pytest.approx(10.64)
    clock.take(state(1.602, 10.643), transit_known=True)  # from then on drift is followed as before
    assert clock.expiry(state(1.604, 10.645)) == pytest.approx(10.644 + 0.002 * DRIFT, abs=1e-7)


def test_a_clock_that_stood_still_is_tied_anew_once_nothing_younger_comes() -> None:
    clock = ControllerClock(500.0, hold=0.04, clock=SYSTEM)
    now = time.monotonic()
    clock.take(state(1.0, now - 0.3))
    for k in range(25):  # its clock stood still for 0.25 s, as it seems
        late = state(1.0 + 0.002 * k, now - 0.05 + 0.002 * k)
        clock.take(late)
        if not 19 <= k <= 21:
            assert (clock.expiry(late) < late.received) == (k < 20)


def test_once_armed_samples_that_come_later_for_good_stay_old() -> None:
    clock = ControllerClock(500.0, hold=0.04, clock=SYSTEM)
    now = time.monotonic()
    clock.take(state(1.0, now - 3.0), transit_known=True)
    for k in range(1, 1000):  # from then on 0.21 s later than before
        late = state(1.0 + 0.002 * k, now - 3.0 + 0.21 + 0.002 * k)
        clock.take(late, transit_known=True)
        assert clock.expiry(late) < late.received
    clock.take(state(3.0, now - 0.79), transit_known=False)  # the driver has been released
    late = state(3.002, now - 0.788)
    clock.take(late)
    assert clock.expiry(late) > late.received


@pytest.mark.parametrize("growth", [5e-4, 4.5e-3])
def test_a_delay_that_grows_is_no_drift_for_longer_than_a_round_trip_shows(growth: float) -> None:
    hand, way = ByHand(), 0.001  # s
    clock = ControllerClock(500.0, hold=0.04, clock=hand)
    for k in range(round(0.1 / growth) * 500):
        sampled, hand.now = 1.0 + 0.002 * k, 10.0 + (0.002 + growth * 0.002) * k
        late = state(sampled, hand.now)
        clock.take(late, transit_known=True)
        clock.measured(way + growth * 0.002 * k, way)
        hidden = hand.now - 9.0 - sampled - clock.age(late)
        assert hidden <= GROWTH + 1e-9
    assert clock.expiry(late) < late.received


@pytest.mark.parametrize("drift", [1e-4, -1e-4, 5e-4])
def test_a_clock_that_drifts_is_followed_while_round_trips_stay_short(drift: float) -> None:
    hand, way = ByHand(), 0.001  # s
    clock = ControllerClock(500.0, hold=0.04, clock=hand)
    for k in range(100_000):
        hand.now = 10.0 + 0.002 * k
        now = state(1.0 + 0.002 * k * (1.0 - drift), hand.now)
        clock.take(now, transit_known=True)
        if k % 100 == 99:
            clock.measured(way + 0.002, way)
        assert clock.age(now) < 1e-3


def test_without_round_trips_a_clock_is_followed_by_a_bound_once_armed() -> None:
    hand = ByHand()
    clock = ControllerClock(500.0, hold=0.04, clock=hand)
    for k in range(100_000):
        hand.now = 10.0 + 0.002 * k * (1.0 + 5e-4)
        late = state(1.0 + 0.002 * k, hand.now)
        clock.take(late, transit_known=True)
    assert clock.age(late) == pytest.approx(hand.now - 9.0 - late.timestamp - GROWTH, abs=1e-6)
    clock.take(late, transit_known=False)  # released: what may grow is what an arming measures
    for k in range(100_000, 200_000):
        hand.now = 10.0 + 0.002 * k * (1.0 + 5e-4)
        clock.take(late := state(1.0 + 0.002 * k, hand.now))
    assert clock.age(late) < 1e-3


def test_a_clock_that_is_set_forward_behind_late_samples_makes_none_of_them_younger() -> None:
    clock = ControllerClock(500.0, hold=0.04, clock=SYSTEM)
    for k in range(50):
        clock.take(state(1.0 + 0.002 * k, 10.0 + 0.002 * k), transit_known=True)
    for k in range(50, 500):  # 45 to 60 ms late; meanwhile it is set forward by 50 ms
        set_by = 0.05 if k > 55 else 0.0
        late = state(1.0 + set_by + 0.002 * k, 10.045 + 0.002 * k + 0.015 * (k % 7) / 6)
        clock.take(late, transit_known=True)
        assert clock.expiry(late) < late.received
    for k in range(500, 520):  # they come in time again
        fresh = state(1.05 + 0.002 * k, 10.0 + 0.002 * k)
        clock.take(fresh, transit_known=True)
        assert clock.expiry(fresh) == pytest.approx(fresh.received + 0.04, abs=1e-6)


def test_the_newest_of_what_a_link_held_back_counts_once_others_come_as_quickly() -> None:
    clock = ControllerClock(500.0, hold=0.04, clock=SYSTEM)
    for k in range(50):
        clock.take(state(1.0 + 0.002 * k, 10.0 + 0.002 * k), transit_known=True)
    clock.take(state(1.1, 10.16), transit_known=True)  # 60 ms late; the next one read is in time
    fresh = []
    for k in range(80, 90):
        newest = state(1.0 + 0.002 * k, 10.0 + 0.002 * k)
        clock.take(newest, transit_known=True)
        fresh.append(clock.expiry(newest) > newest.received)
    assert fresh == [False] * 4 + [True] * 6


def test_what_a_stalled_link_hands_on_at_once_is_old_until_the_newest_has_come() -> None:
    clock = ControllerClock(500.0, hold=0.04, clock=SYSTEM)
    now = time.monotonic()
    clock.take(state(1.0, now - 0.1))
    fresh = []
    for k in range(1, 51):  # of 0.1 s, all within 1 ms
        burst = state(1.0 + 0.002 * k, now + 2e-5 * k)
        clock.take(burst)
        fresh.append(clock.expiry(burst) > burst.received)
    assert not any(fresh[:29])
    assert all(fresh[31:])


@pytest.fixture
def memory():
    found = SharedMemory(3, clock=SYSTEM)
    yield found
    found.close()


def put(memory: SharedMemory, timestamp: float) -> None:
    row = memory.next_row()
    write_cycle(row, memory.slices, state(timestamp), Q, Q + 1, np.arange(6.0))
    row[2:9] = 0
    memory.publish()


def test_rows_come_through_once_and_in_order(memory: SharedMemory) -> None:
    reader = memory.reader()
    for k in range(5):
        put(memory, float(k))
    rows = reader.drain()
    assert rows[:, 1].tolist() == [0, 1, 2, 3, 4]
    assert rows[0, memory.slices["corrected_q"]] == pytest.approx(Q + 1)
    assert rows[0, memory.slices["offset"]] == pytest.approx(np.arange(6))
    assert np.isnan(rows[0, memory.slices["ft_raw_wrench"]]).all()
    assert np.isnan(rows[0, memory.slices["payload"]]).all()
    assert len(reader.drain()) == 0
    put(memory, 5.0)
    assert reader.drain()[:, 1].tolist() == [5]


def test_rows_that_were_overwritten_are_counted_not_invented(memory: SharedMemory) -> None:
    reader = memory.reader()
    for k in range(2 * ROWS):
        put(memory, float(k))
    rows = reader.drain()
    assert rows[-1, 1] == 2 * ROWS - 1
    assert (np.diff(rows[:, 1]) == 1).all()
    assert len(rows) + reader.lost == 2 * ROWS


def test_a_row_that_was_not_finished_is_not_read(memory: SharedMemory) -> None:
    reader = memory.reader()
    put(memory, 1.0)
    memory.next_row()[1] = 99.0  # the loop was killed here
    assert reader.drain()[:, 1].tolist() == [1]


def test_another_process_sees_the_same_memory_and_its_death_leaves_it_whole() -> None:
    memory = RunMemory(3, clock=SYSTEM)
    memory.renew()
    code = f"""
import os, time
from gapbridge.bridge.ipc.shared_memory import SharedMemory, Phase
from gapbridge.drivers.clock import SYSTEM
memory = SharedMemory(3, {memory.fd}, clock=SYSTEM)
memory.enter(Phase.RUNNING)
memory.note_state(3)
memory.note_state_read()
for k in range(10):
    memory.next_row()[1] = k
    memory.publish()
memory.next_row()[1] = 77
os.abort()
"""
    done = subprocess.run([sys.executable, "-c", code], pass_fds=[memory.fd], check=False)
    assert done.returncode == -6
    assert (memory.phase, memory.state, memory.has_state, memory.ended) == (
        Phase.RUNNING,
        3,
        True,
        False,
    )
    assert memory.reader().drain()[:, 1].tolist() == list(range(10))
    assert 0 < memory.silence < 30
    assert os.fstat(memory.fd).st_nlink == 0
    memory.close()
