"""The checks of every cycle: what is dropped, what holds, what is reported, and each only once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.loop.checks import (
    DEGRADED,
    LATE,
    RESYNC,
    FrozenWatch,
    LoopChecks,
    OverrunWatch,
    SaturationWatch,
)
from gapbridge.bridge.loop.link_monitor import LinkMonitor, hold_time
from gapbridge.bridge.loop.reports import Reports
from gapbridge.bridge.loop.supervisor import Supervisor
from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import Implausible, InvalidStateError, StaleStateError
from gapbridge.core.limits import ENVELOPE, RATE
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState
from gapbridge.drivers.clock import SYSTEM, Clock
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.state_check import SampleCheck

ARM = builtin_arm("ur10e")
Q = np.array([0.0, -1.5, 1.8, -1.87, -1.57, 0.0])
T = 0.002


def state(at: float, q: np.ndarray = Q, **more: Any) -> RobotState:
    given = {"actual_TCP_force": np.zeros(6), "target_q": q, **more}
    return RobotState(at, 0.0, q, given.pop("actual_qd", np.zeros(6)), **given)


# -- samples ---------------------------------------------------------------------------------------


def changed(index: int, value: float) -> np.ndarray:
    found = Q.copy()
    found[index] = value
    return found


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        ({"q": changed(2, np.nan)}, Implausible.NOT_FINITE),
        ({"q": changed(2, np.inf)}, Implausible.NOT_FINITE),
        ({"target_q": changed(0, np.nan)}, Implausible.NOT_FINITE),
        ({"actual_qd": changed(0, np.nan)}, Implausible.NOT_FINITE),
        ({"actual_TCP_force": np.full(6, np.nan)}, Implausible.NOT_FINITE),
        ({"actual_TCP_force": np.full(6, 1e5)}, Implausible.VALUE),
        ({"q": changed(1, 8.0)}, Implausible.VALUE),
        ({"q": changed(1, -1.4)}, Implausible.STEP),
    ],
)
def test_a_sample_that_cannot_be_is_dropped_with_its_reason(
    bad: dict[str, Any], reason: Implausible
) -> None:
    check = SampleCheck(ARM)
    check.check(state(1.0))
    with pytest.raises(InvalidStateError) as caught:
        check.check(state(1.0 + T, **bad))
    assert caught.value.reason == reason
    check.check(state(1.0 + 2 * T))  # the next good one is believed


def test_a_clock_that_goes_back_is_no_sample_and_a_lost_force_is_no_reason_to_drop() -> None:
    check = SampleCheck(ARM)
    check.check(state(1.0))
    with pytest.raises(InvalidStateError, match="clock went back") as caught:
        check.check(state(0.9))
    assert caught.value.reason == Implausible.BACKWARDS
    lost = state(1.1, actual_TCP_force=np.full(6, np.nan), sensor_lost="silent")
    check.check(lost)


@given(st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6), st.floats(1e-3, 0.2))
def test_what_an_arm_can_do_is_never_dropped(share: list[float], gap: float) -> None:
    check = SampleCheck(ARM)
    check.check(state(1.0))
    moved = Q + np.array(share) * ARM.limits.velocity * gap
    check.check(state(1.0 + gap, moved))


# -- watches ---------------------------------------------------------------------------------------


def test_values_that_stand_still_under_a_moving_command_are_frozen_after_a_second() -> None:
    watch = FrozenWatch()
    events = [watch.update(state(k * T), Q + 1e-5 * k) for k in range(1000)]
    first = next(k for k, phrase in enumerate(events) if phrase)
    assert 695 <= first <= 705  # 2 mrad away after 0.4 s


@pytest.mark.parametrize("ahead", [0.05, 0.9])
def test_an_arm_that_begins_to_move_after_a_rest_is_not_frozen(ahead: float) -> None:
    # velocity and command are ahead of joints in counts, and of an arm that has to be set going
    watch, rest = FrozenWatch(), 2.0
    for k in range(2000):
        t = k * T
        speed = 0.024 if t > rest else 0.0
        q = Q + 0.001 * np.floor(1e3 * max(0.024 * (t - rest - ahead), 0.0))
        command = Q + 0.5 * max(t - rest, 0.0)
        assert watch.update(state(t, q, actual_qd=np.full(6, speed)), command) is None, t


def test_an_arm_at_rest_or_one_that_moves_is_not_frozen() -> None:
    watch = FrozenWatch()
    assert not any(watch.update(state(k * T), Q) for k in range(2000))
    moving = FrozenWatch()
    assert not any(moving.update(state(k * T, Q + 1e-6 * k), Q + 1e-5 * k) for k in range(2000))


def test_joints_that_say_they_turn_and_do_not_change_are_frozen() -> None:
    watch = FrozenWatch()
    turning = np.full(6, 0.1)
    assert any(watch.update(state(k * T, actual_qd=turning), Q) for k in range(600))


def test_an_arm_at_rest_is_not_frozen_once_a_person_has_disarmed_it() -> None:
    watch, away = FrozenWatch(), Q + 0.3  # one wrong command, or a motor that was off
    assert watch.update(state(0.0), Q) is None
    assert any(watch.update(state(k * T), away) for k in range(1, 600))
    watch.acknowledge()
    assert not any(watch.update(state(k * T), away) for k in range(600, 1500))
    assert any(watch.update(state(k * T), Q) for k in range(1500, 2100))  # and moves: frozen again


def test_joints_that_say_they_turn_are_frozen_whoever_disarms() -> None:
    watch, turning = FrozenWatch(), np.full(6, 0.1)
    assert any(watch.update(state(k * T, actual_qd=turning), Q) for k in range(600))
    watch.acknowledge()
    assert watch.update(state(600 * T, actual_qd=turning), Q) is not None


def test_more_than_a_twentieth_of_the_cycles_missed_is_an_overrun() -> None:
    fine, bad = OverrunWatch(500.0), OverrunWatch(500.0)
    assert not any(fine.update(k * T, k % 25 == 0) for k in range(2000))
    assert any(bad.update(k * T, k % 15 == 0) for k in range(2000))
    single = OverrunWatch(500.0)
    assert single.update(1.0, 100) is None


def test_an_offset_at_its_limit_for_a_second_is_saturated_and_a_ramp_is_not() -> None:
    watch = SaturationWatch()
    events = [watch.update(k * T, 1 << ENVELOPE) for k in range(600)]
    assert not any(events[:500])
    assert all(events[502:])
    assert watch.update(2.0, 0) is None
    assert not any(watch.update(3 + k * T, 1 << RATE) for k in range(1000))


# -- together --------------------------------------------------------------------------------------


class Bench:
    """Checks with a supervisor in a state, and what they have reported."""

    def __init__(self, memory: SharedMemory, at: State) -> None:
        self.events: list[dict[str, Any]] = []
        self.memory = memory
        self.supervisor = Supervisor(lambda *change: self.changes.append(change))
        self.changes: list[Any] = []
        self.supervisor.state = at
        self.checks = LoopChecks(500.0, self.supervisor, Reports(memory, self.events.append))


@pytest.fixture
def memory() -> Iterator[SharedMemory]:
    found = SharedMemory(6, clock=SYSTEM)
    yield found
    found.close()


def test_a_stop_of_the_robot_is_a_fault_counted_and_reported_once(memory: SharedMemory) -> None:
    bench = Bench(memory, State.COMPENSATING)
    bench.checks.begin(state(1.0), 0)
    for k in range(100):
        bench.checks.begin(state(1.0 + T * (k + 1), safety_mode=3), 0)
    assert bench.supervisor.state == State.FAULT
    assert len(bench.changes) == 1
    assert bench.events == []
    assert memory.counts()["unsafe"] == 1
    assert "safety_mode 3" in bench.checks.not_ready
    bench.checks.begin(state(2.0), 0)
    assert not bench.checks.not_ready


def test_a_gap_of_more_than_ten_cycles_and_the_hold_time_begins_anew(memory: SharedMemory) -> None:
    bench = Bench(memory, State.COMPENSATING)
    assert bench.checks.begin(state(1.0), 0) == 0
    assert bench.checks.begin(state(1.03), 14) == LATE
    assert bench.supervisor.state == State.COMPENSATING
    assert bench.checks.begin(state(1.10), 34) == LATE | RESYNC
    assert bench.supervisor.state == State.HOLDING
    assert bench.checks.begin(state(1.102), 0) == 0
    assert memory.counts()["resync"] == 1
    assert memory.counts()["late"] == 48


def test_a_lost_sensor_is_flagged_in_every_cycle_and_reported_twice(memory: SharedMemory) -> None:
    bench = Bench(memory, State.COMPENSATING)
    for k in range(10):
        sample = state(1.0 + k * T, sensor_lost="silent" if 3 <= k < 7 else "")
        flags = (DEGRADED if 3 <= k < 7 else 0) | (LATE if k == 5 else 0)
        assert bench.checks.begin(sample, k == 5) == flags
    assert [event["detail"] for event in bench.events] == ["silent", "the sensor is back"]
    assert bench.supervisor.state == State.COMPENSATING
    assert memory.counts()["sensor_lost"] == 1


@pytest.mark.parametrize("at", [State.OBSERVING, State.COMPENSATING])
def test_what_comes_and_goes_fills_no_log_and_its_last_state_is_told(
    memory: SharedMemory, at: State
) -> None:
    """A loose cable: events that do not fit into their socket, a fault's too, would be lost."""
    bench, seconds = Bench(memory, at), 4
    cycles = round(seconds / T)
    for k in range(cycles):
        more = {"sensor_lost": "silent"} if k % 2 else {}
        bench.checks.begin(state(1.0 + k * T, **more), 0)
        if at == State.OBSERVING:
            bench.checks.check_loads("force 620 N" if k % 2 else None)
    kinds = [(event["kind"], event["what"]) for event in bench.events]
    assert 1 <= kinds.count(("degraded", "sensor_lost")) <= seconds
    assert kinds.count(("degraded", "")) <= seconds
    assert kinds.count(("warning", "load")) <= seconds
    assert memory.counts()["sensor_lost"] == cycles // 2
    for k in range(cycles, 2 * cycles):  # now it is lost for good
        bench.checks.begin(state(1.0 + k * T, sensor_lost="silent"), 0)
    assert bench.events[-1]["what"] == "sensor_lost"
    bench.checks.begin(state(1.0 + 2 * cycles * T), 0)
    assert bench.events[-1]["detail"] == "the sensor is back"


def test_while_only_observing_a_finding_is_reported_and_changes_nothing(
    memory: SharedMemory,
) -> None:
    bench = Bench(memory, State.OBSERVING)
    for k in range(2000):
        bench.checks.end(state(k * T), Q + 1e-5 * k, 0, 1e-4)
    assert bench.supervisor.state == State.OBSERVING
    assert [event["what"] for event in bench.events] == ["frozen"]
    assert memory.counts()["frozen"] == 1


class Scripted(Driver):
    """A driver that does what it is asked to; no wire could be so exact about three in a row."""

    def __init__(self, clock: Clock = SYSTEM) -> None:
        super().__init__(500.0, Model(ARM), clock=clock)
        self.next: RobotState | Exception = state(0.0)

    def connect(self) -> None: ...

    def _read_state(self) -> RobotState:
        if isinstance(self.next, Exception):
            raise self.next
        self.next = self.next._replace(timestamp=self.next.timestamp + T)
        return self.next

    def _send(self, setpoint: object) -> None: ...

    def close(self) -> None: ...


def watched(
    memory: SharedMemory, now: list[float] | None = None
) -> tuple[Scripted, Supervisor, LinkMonitor, list[dict[str, Any]]]:
    """``now``: the time, s, where it is not the system's."""
    events: list[dict[str, Any]] = []
    clock = Clock()
    if now is not None:
        clock.monotonic = lambda: now[0]
    driver, supervisor = Scripted(clock), Supervisor(lambda *_: None)
    supervisor.state = State.COMPENSATING
    watch = LinkMonitor(driver, supervisor, Reports(memory, events.append))
    return driver, supervisor, watch, events


def test_two_bad_samples_are_dropped_and_three_in_a_row_hold(memory: SharedMemory) -> None:
    driver, supervisor, watch, events = watched(memory)
    good = driver.next
    for times, after in ((2, State.COMPENSATING), (3, State.HOLDING)):
        driver.next = InvalidStateError("torn")
        for _ in range(times):
            assert watch.next() is None
        assert supervisor.state == after
        driver.next = good
        assert watch.next() is not None
        watch.accept()
    assert memory.counts()["dropped_torn"] == 5
    assert [event["what"] for event in events] == ["dropped_torn"]  # not five times


@pytest.mark.parametrize(("armed", "longest"), [(False, 3.0), (True, 0.5)])
def test_a_silent_link_is_lost_and_sooner_once_it_was_armed(
    memory: SharedMemory, armed: bool, longest: float
) -> None:
    """The library of a UR cannot write after a break."""
    clock = [100.0]
    driver, _, watch, _ = watched(memory, clock)
    driver.next = StaleStateError("the clock stands still")
    while not watch.lost and clock[0] < 110.0:
        clock[0] += 0.01
        assert watch.next(armed) is None
    assert longest < clock[0] - 100.0 < longest + 0.02


def test_a_state_that_is_late_is_counted_and_only_a_stale_one_holds(memory: SharedMemory) -> None:
    clock = [100.0]
    driver, supervisor, watch, _ = watched(memory, clock)
    driver.next = StaleStateError("the clock stands still")
    seen = []
    for _ in range(30):
        clock[0] += 0.0101
        assert watch.next() is None
        seen.append(supervisor.state)
    held = seen.index(State.HOLDING)
    assert hold_time(500.0) < 0.0101 * (held + 1) <= hold_time(500.0) + 0.0101
    fault = seen.index(State.FAULT)
    assert 0.2 < 0.0101 * (fault + 1) <= 0.22
    counts = memory.counts()
    assert (counts["late"], counts["stale"], counts["silence"]) == (held, 1, 1)


@pytest.mark.parametrize(("rate", "hold"), [(500, 0.04), (125, 0.04), (50, 0.1), (10, 0.2)])
def test_the_hold_time_is_five_cycles_or_forty_milliseconds(rate: float, hold: float) -> None:
    assert hold_time(rate) == pytest.approx(hold)


# -- while observing, and what a robot says beside its modes ---------------------------------------


@pytest.mark.parametrize("bits", [1 << bit for bit in range(2, 11)])
def test_a_stop_in_the_safety_bits_alone_is_a_fault(memory: SharedMemory, bits: int) -> None:
    bench = Bench(memory, State.COMPENSATING)
    bench.checks.begin(state(1.0), 0)
    bench.checks.begin(state(1.0 + T, safety_status_bits=1 | bits), 0)
    assert bench.supervisor.state == State.FAULT
    assert f"safety_status_bits {1 | bits:#b}" in bench.checks.not_ready


@pytest.mark.parametrize("bits", [1, 2])
def test_normal_and_reduced_mode_are_no_stop(memory: SharedMemory, bits: int) -> None:
    bench = Bench(memory, State.COMPENSATING)
    bench.checks.begin(state(1.0, safety_status_bits=bits), 0)
    assert bench.supervisor.state == State.COMPENSATING


@pytest.mark.parametrize(
    ("found", "moves_arm", "holds"),
    [
        ({"runtime_state": 4}, True, True),
        ({"runtime_state": 4}, False, True),
        ({"speed_scaling": 0.5}, True, True),
        ({"speed_scaling": 0.5}, False, False),  # the robot's own motion, at its own speed
        ({"speed_scaling": np.nan}, False, True),
        ({"speed_scaling": 50.0}, False, True),
        ({"speed_scaling": 1.0}, True, False),
    ],
)
def test_a_robot_that_does_not_follow_for_the_hold_time_is_held(
    memory: SharedMemory, found: dict[str, Any], moves_arm: bool, holds: bool
) -> None:
    bench = Bench(memory, State.COMPENSATING)
    bench.checks = LoopChecks(
        500.0, bench.supervisor, Reports(memory, bench.events.append), moves_arm=moves_arm
    )
    for k in range(40):
        bench.checks.begin(state(1.0 + k * T, **(found if k >= 10 else {})), 0)
        if k == 10 + round(0.9 * hold_time(500.0) / T):
            assert bench.supervisor.state == State.COMPENSATING  # a moment is none
    assert (bench.supervisor.state == State.HOLDING) == holds
    assert memory.counts()["not_following"] == holds


def test_a_program_that_does_not_play_is_nobodys_fault_while_nothing_is_written(
    memory: SharedMemory,
) -> None:
    bench = Bench(memory, State.OBSERVING)
    for k in range(100):
        bench.checks.begin(state(1.0 + k * T, runtime_state=1), 0)
    assert memory.counts()["not_following"] == 0
    bench.supervisor.state = State.COMPENSATING  # as it was armed: the program has just begun
    bench.checks.begin(state(1.0 + 100 * T, runtime_state=1), 0)
    bench.checks.begin(state(1.0 + 101 * T), 0)
    assert bench.supervisor.state == State.COMPENSATING


def test_a_load_that_cannot_be_holds_and_is_reported_with_its_reason(memory: SharedMemory) -> None:
    bench = Bench(memory, State.COMPENSATING)
    for _ in range(3):
        bench.checks.check_loads("payload: found 400 kg, expected 0 to 7.5 kg")
    assert bench.supervisor.state == State.HOLDING
    assert bench.changes[0][3] == "payload: found 400 kg, expected 0 to 7.5 kg"
    assert memory.counts()["load"] == 1


class Otherwise(Scripted):
    """A driver whose controller is set otherwise, from some moment on."""

    asked, phrase = 0, ""

    def mismatch(self) -> str | None:
        self.asked += 1
        return self.phrase or None


def test_the_controllers_settings_are_compared_every_second_while_armed(
    memory: SharedMemory,
) -> None:
    bench, driver = Bench(memory, State.OBSERVING), Otherwise()
    for k in range(1000):
        bench.checks.check_settings(state(1.0 + k * T), driver)
    assert driver.asked == 0
    bench.supervisor.state = State.COMPENSATING
    for k in range(1000):
        bench.checks.check_settings(state(3.0 + k * T), driver)
    assert driver.asked == 2
    driver.phrase = "the controller's TCP is 50.0 mm from the cell's"
    for k in range(501):
        bench.checks.check_settings(state(5.0 + k * T), driver)
    assert bench.supervisor.state == State.HOLDING
    assert bench.changes[0][3] == driver.phrase


def test_a_hiccup_while_observing_latches_no_fault(memory: SharedMemory) -> None:
    clock = [100.0]
    driver, supervisor, watch, events = watched(memory, clock)
    supervisor.state = State.OBSERVING
    good = driver.next
    driver.next = StaleStateError("the clock stands still")
    for _ in range(30):
        clock[0] += 0.0101
        assert watch.next() is None
    assert supervisor.state == State.OBSERVING
    assert memory.counts()["silence"] == 1
    assert [event["what"] for event in events] == ["stale"]
    driver.next = good
    assert watch.next() is not None
    watch.accept()
    assert supervisor.state == State.OBSERVING
