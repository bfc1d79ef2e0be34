"""What the loop does with setpoints that must not, cannot or did not leave."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clock_by_hand import ByHand

from gapbridge.bridge.cell.sections import LimitSettings, SetpointSettings
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.loop.link_monitor import hold_time
from gapbridge.bridge.loop.live_loads import LiveLoads
from gapbridge.bridge.loop.offset_in_force import OffsetInForce
from gapbridge.bridge.loop.reports import Reports
from gapbridge.bridge.loop.setpoint_stream import SetpointStream
from gapbridge.bridge.loop.supervisor import Cause, Supervisor
from gapbridge.bridge.loop.writing import PARTIAL_WRITE_LIMIT, SETTLING_TIMEOUT, Writing
from gapbridge.bridge.setpoint_source import make_source
from gapbridge.core.arm import builtin_arm
from gapbridge.core.compensation import Correction
from gapbridge.core.errors import (
    ForeignCommandError,
    GateError,
    IneffectiveWriteError,
    InputError,
    LateSetpointError,
    LinkError,
    PartialWriteError,
    RobotBusyError,
    WriteError,
)
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.driver import Driver

Q = np.array([0.0, -1.5, 1.8, -1.87, -1.57, 0.0])
T = 0.002
CLOCK = ByHand()
MODEL = Model(builtin_arm("ur10e")).with_compliance([1e-6] * 6, [1e-6] * 6)


class Failing(Driver):
    """A driver whose writes fail as they are asked to; no wire fails so exactly."""

    def __init__(self) -> None:
        super().__init__(500.0, MODEL, clock=CLOCK)
        self.error: LinkError | None = None
        self.lapsed = False
        self.sent: list[np.ndarray] = []
        self.released = 0
        self.taken: float | None = None  # s, of a question and its answer

    def round_trip(self) -> float | None:
        return self.taken

    def transit_time(self) -> float:
        return self.taken or 0.0  # measured when arming, as a UR's

    def connect(self) -> None: ...

    def _read_state(self) -> RobotState:
        raise NotImplementedError

    def _send(self, setpoint: Setpoint) -> None:
        if self.error is not None:
            raise self.error
        self.sent.append(setpoint.q.copy())

    def _take_lapsed(self) -> bool:
        lapsed, self.lapsed = self.lapsed, False
        return lapsed

    def _release(self) -> None:
        self.released += 1

    def close(self) -> None: ...


class Stream(SetpointStream):
    """A stream whose model can be made to give no numbers."""

    broken = False
    unsolvable = 0.0  # m: what is missed instead

    def correct(self, nominal_q: np.ndarray, loads: Loads) -> Correction:
        found = super().correct(nominal_q, loads)
        if self.broken:
            self.residual, self.missed, self.finite = np.nan, np.nan, False
        if self.unsolvable:
            self.residual = self.missed = self.unsolvable
        return found


class Bench:
    """A loop's writing half, compensating."""

    def __init__(self, memory: SharedMemory) -> None:
        self.memory, self.driver = memory, Failing()
        self.changes: list[tuple[str, str]] = []  # cause and detail
        self.supervisor = Supervisor(lambda *change: self.changes.append(change[2:]))
        self.supervisor.state = State.ARMED
        self.stream = Stream(MODEL, LimitSettings(), 500.0, clock=CLOCK)
        self.loads = LiveLoads(6, True, 0.0)
        settings = SetpointSettings()
        source = make_source(settings, 6, True, Path(), clock=CLOCK)
        reports = Reports(memory, lambda _: None)
        self.writing = Writing(settings, self.driver, source, self.stream, self.supervisor, reports)
        self.at, self.q = 1.0, Q
        self.writing.start(self.state(), Q)
        self.writing.start(self.state(), Q)
        assert self.supervisor.state == State.COMPENSATING

    def state(self) -> RobotState:
        self.at += T
        return RobotState(self.at, 0.0, self.q, np.zeros(6), self.q, np.zeros(6))

    def rearm(self) -> None:
        """Arm once more where the arm was left."""
        self.supervisor.state = State.ARMED
        for _ in range(2):
            self.writing.start(self.state(), self.q)
        assert self.supervisor.state == State.COMPENSATING

    def cycles(self, count: int) -> None:
        for _ in range(count):
            state = self.state()
            if self.supervisor.state.writes:
                self.writing.write(state, self.q, self.loads.update(state))
                self.driver.gate.set_clock(lambda: self.at)

    def count(self, name: str) -> int:
        return self.memory.counts()[name]


@pytest.fixture
def bench() -> Iterator[Bench]:
    memory = SharedMemory(6, clock=CLOCK)
    yield Bench(memory)
    memory.close()


def test_a_correction_that_is_no_number_never_leaves_and_is_a_fault(bench: Bench) -> None:
    bench.cycles(50)
    sent = len(bench.driver.sent)
    assert sent == 50
    bench.stream.broken = True
    bench.cycles(50)
    assert bench.supervisor.state == State.FAULT
    assert len(bench.driver.sent) == sent
    assert bench.driver.released == 1
    assert bench.count("bad_output") == 1


@pytest.mark.parametrize("residual", [np.inf, 1e-3])
def test_an_unsolved_correction_ends_the_motion_and_its_offset_is_ramped_out(
    bench: Bench, residual: float
) -> None:
    bench.cycles(400)
    before = len(bench.driver.sent)
    assert np.abs(bench.stream.limiter.offset_in_base[:3]).max() > 5e-5
    bench.stream.unsolvable = residual
    bench.cycles(1)
    assert bench.supervisor.state == State.HOLDING
    assert "correction unsolved" in bench.changes[-1][0]
    assert ("no equilibrium" if np.isinf(residual) else "1 mm from") in bench.changes[-1][1]
    assert bench.count("unsolved") == 1
    offsets = []
    for _ in range(400):
        bench.cycles(1)
        offsets.append(bench.stream.limiter.offset_in_base.copy())
    assert bench.stream.has_no_offset
    assert len(bench.driver.sent) == before + 401  # ramped out, not dropped
    assert np.abs(bench.driver.sent[-1] - Q).max() < 1e-12
    lengths = np.linalg.norm(offsets, axis=1)
    assert lengths[200] > 0.1 * lengths[0]  # over the ramp's time
    assert np.abs(np.diff(lengths)).max() < 1.1 * lengths[0] / 250


def test_nothing_leaves_that_is_made_of_an_old_state_and_the_next_step_is_no_larger(
    bench: Bench,
) -> None:
    bench.cycles(50)
    sent, offset = len(bench.driver.sent), bench.stream.limiter.offset_in_base
    state = bench.state()
    for expiry in (-np.inf, CLOCK.monotonic() - 1e-6):
        assert bench.writing.write(state, Q, bench.loads.update(state), expiry) is None
    assert len(bench.driver.sent) == sent
    assert (bench.stream.limiter.offset_in_base == offset).all()
    bench.cycles(1)
    assert len(bench.driver.sent) == sent + 1
    assert bench.supervisor.state == State.COMPENSATING


def test_what_takes_the_watchdog_too_long_to_notice_lets_nothing_old_leave(bench: Bench) -> None:
    bench.driver.keep_alive = lambda: CLOCK.sleep(0.03)  # type: ignore[method-assign]
    state = bench.state()
    expiry = CLOCK.monotonic() + 0.02
    assert bench.writing.write(state, Q, bench.loads.update(state), expiry) is None
    assert not bench.driver.sent
    assert bench.count("late") == 1


def test_nothing_leaves_while_a_setpoint_is_unanswered_for_longer_than_a_state_may_be_old(
    bench: Bench,
) -> None:
    """500 Hz: 40 ms. A sample that does not know of that setpoint was taken before it came."""
    since = CLOCK.monotonic()
    bench.driver.unanswered_since = lambda: since - 0.041  # type: ignore[method-assign]
    state = bench.state()
    assert bench.writing.write(state, Q, bench.loads.update(state)) is None
    assert not bench.driver.sent
    assert bench.count("late") == 1
    assert bench.supervisor.state == State.COMPENSATING  # the driver says when it is too long
    bench.driver.unanswered_since = lambda: CLOCK.monotonic() - 0.02  # type: ignore[method-assign]
    bench.cycles(1)
    assert len(bench.driver.sent) == 1


def test_a_process_that_was_stopped_after_the_judgement_sends_nothing_old(bench: Bench) -> None:
    bench.cycles(50)
    sent, limit = len(bench.driver.sent), bench.stream.limiter.limit

    def stopped_after(*given: Any) -> Any:
        found = limit(*given)
        CLOCK.sleep(0.03)
        return found

    bench.stream.limiter.limit = stopped_after  # type: ignore[method-assign]
    state = bench.state()
    expiry = CLOCK.monotonic() + 0.02
    assert bench.writing.write(state, Q, bench.loads.update(state), expiry) is None
    assert bench.writing.unsent is not None
    assert len(bench.driver.sent) == sent
    assert bench.count("late") == 1
    assert bench.supervisor.state == State.COMPENSATING
    bench.stream.limiter.limit = limit  # type: ignore[method-assign]
    bench.cycles(1)
    assert len(bench.driver.sent) == sent + 1


def test_a_process_that_was_stopped_while_it_sent_reports_so_and_ends_the_motion(
    bench: Bench,
) -> None:
    bench.driver._send = lambda _: CLOCK.sleep(0.03)  # type: ignore[method-assign]
    state = bench.state()
    expiry = CLOCK.monotonic() + 0.02
    assert bench.writing.write(state, Q, bench.loads.update(state), expiry) is not None
    assert bench.supervisor.state == State.HOLDING
    assert bench.count("overrun") == 1


def test_a_setpoint_that_left_in_part_is_followed_by_a_whole_one(bench: Bench) -> None:
    bench.cycles(10)
    bench.driver.error = PartialWriteError("1 of 3 frames")
    bench.cycles(PARTIAL_WRITE_LIMIT - 1)
    bench.driver.error = None
    bench.cycles(10)
    assert bench.supervisor.state == State.COMPENSATING
    assert len(bench.driver.sent) == 20
    assert bench.count("write_partial") == PARTIAL_WRITE_LIMIT - 1
    assert bench.count("write_ineffective") == 0


def test_a_setpoint_that_waits_for_a_busy_robot_is_neither_sent_nor_in_force(bench: Bench) -> None:
    """Its offset would be taken off the next start, though the arm never had it."""
    bench.cycles(700)
    sent = bench.driver.sent[-1]
    in_force = bench.writing._in_force.offset_at(sent)
    bench.supervisor.take(Cause.DISARM)
    bench.driver.error = RobotBusyError("on its way")
    bench.cycles(700)
    assert bench.supervisor.state == State.HOLDING
    assert bench.stream.at_rest
    assert bench.writing.unsent is not None
    after = bench.writing._in_force.offset_at(sent)
    assert in_force is not None and after is not None
    assert (after.delta == in_force.delta).all()
    assert (bench.count("write_failed"), bench.count("setpoint_refused")) == (0, 0)
    bench.driver.error = None  # its way ends: the newest setpoint leaves
    bench.cycles(1)
    assert bench.driver.sent[-1] == pytest.approx(Q, abs=1e-12)


def _is_late(bench: Bench) -> None:
    limit = bench.stream.limiter.limit
    bench.stream.limiter.limit = lambda *given: (limit(*given), CLOCK.sleep(0.03))[0]  # type: ignore[method-assign]
    state = bench.state()
    bench.writing.write(state, Q, bench.loads.update(state), CLOCK.monotonic() + 0.02)
    bench.stream.limiter.limit = limit  # type: ignore[method-assign]


def _is_refused(bench: Bench) -> None:
    bench.driver.error = GateError("gate: refused")
    bench.cycles(1)
    bench.driver.error = None


def _lapses(bench: Bench) -> None:
    bench.cycles(1)
    bench.driver.lapsed = True


@pytest.mark.parametrize("never_in_force", [_is_late, _is_refused, _lapses])
def test_a_stream_goes_on_from_what_is_in_force(
    bench: Bench, never_in_force: Callable[[Bench], None]
) -> None:
    """The offset ramps in by up to 5 cycles' allowance at once; not by 6 from what is in force."""
    bench.stream.limiter._block[2] = rate = 1e-4  # m/s: the limiter's, less than the ramp wants
    bench.cycles(20)
    in_force = bench.stream.limiter.offset_in_base
    here = bench.driver.sent[-1]
    stored = bench.writing._in_force.offset_at(here)
    never_in_force(bench)
    moved = bench.stream.limiter.offset_in_base - in_force
    assert np.linalg.norm(moved[:3]) > 0.5 * rate * T
    bench.at += 20 * T  # a gap
    bench.supervisor.state = State.COMPENSATING
    written = len(bench.driver.sent)
    bench.cycles(1)
    assert len(bench.driver.sent) == written + 1
    step = np.linalg.norm((bench.stream.limiter.offset_in_base - in_force)[:3])
    assert 4.9 * rate * T < step <= 5.0 * rate * T * (1.0 + 1e-9)
    assert stored is not None
    bench.writing._in_force.take_back()
    before = bench.writing._in_force.offset_at(here)
    assert before is not None and (before.delta == stored.delta).all()


def test_what_has_lapsed_is_taken_back_once(bench: Bench) -> None:
    bench.cycles(20)
    _lapses(bench)
    bench.cycles(1)
    assert bench.writing.took_back
    first = bench.stream.limiter.offset_in_base
    bench.cycles(1)
    assert not bench.writing.took_back
    assert (np.linalg.norm(bench.stream.limiter.offset_in_base - first)) > 0.0


def test_an_offset_that_never_took_effect_is_not_kept_for_the_next_start(bench: Bench) -> None:
    bench.cycles(20)
    here = bench.driver.sent[-1]
    stored = bench.writing._in_force.offset_at(here)
    _lapses(bench)
    noted = bench.writing._in_force.offset_at(here)
    bench.driver.error = GateError("gate: refused")
    bench.cycles(1)
    found = bench.writing._in_force.offset_at(here)
    assert stored is not None and noted is not None and found is not None
    assert (noted.delta != stored.delta).any()
    assert (found.delta == stored.delta).all()


def test_the_gate_judges_from_what_is_in_force(bench: Bench) -> None:
    bench.cycles(20)
    before = bench.driver.gate._joints[2].copy()
    _lapses(bench)
    assert (bench.driver.gate._joints[2] != before).any()
    assert bench.driver.take_lapsed()
    assert (bench.driver.gate._joints[2] == before).all()


def test_the_driver_is_given_until_when_a_setpoint_may_take_effect(bench: Bench) -> None:
    answered = bench.driver.clock.monotonic()
    bench.driver.unanswered_since = lambda: answered  # type: ignore[method-assign]
    bench.cycles(1)
    assert bench.driver._expiry == answered + hold_time(500.0)


def test_a_setpoint_that_the_driver_gave_up_as_late_is_counted_and_not_in_force(
    bench: Bench,
) -> None:
    bench.cycles(3)
    bench.driver.error = LateSetpointError("took too long to write")
    bench.cycles(1)
    assert bench.writing.unsent is not None
    assert bench.count("late") == 1
    bench.driver.error = None
    bench.cycles(1)
    assert bench.supervisor.state == State.COMPENSATING


@pytest.mark.parametrize(
    ("error", "cycles", "counter"),
    [
        (PartialWriteError("1 of 3"), PARTIAL_WRITE_LIMIT, "write_ineffective"),
        (IneffectiveWriteError("no echo"), 1, "write_ineffective"),
        (ForeignCommandError("two masters"), 1, "foreign"),
    ],
)
def test_what_a_live_link_does_not_take_holds_and_then_is_a_fault(
    bench: Bench, error: LinkError, cycles: int, counter: str
) -> None:
    bench.driver.error = error
    bench.cycles(cycles)
    assert bench.supervisor.state == State.HOLDING
    assert bench.count(counter) == 1
    bench.cycles(cycles)
    assert bench.supervisor.state == State.FAULT
    assert bench.driver.released == 1
    assert bench.writing.lost is None
    bench.cycles(10)
    assert bench.driver.sent == []


def test_a_write_that_fails_gives_the_link_up(bench: Bench) -> None:
    bench.driver.error = WriteError("the script has ended")
    bench.cycles(3)
    assert bench.supervisor.state == State.FAULT
    assert bench.writing.lost == "the script has ended"
    assert bench.count("write_failed") == 1


def test_holding_brings_the_offset_to_nothing_and_no_step_is_too_large(bench: Bench) -> None:
    bench.cycles(500)
    last = bench.stream.limiter.offset_in_base
    assert np.abs(last).max() > 0.0
    bench.driver.error = IneffectiveWriteError("no echo")
    bench.cycles(1)
    bench.driver.error = None
    bench.cycles(600)
    assert bench.supervisor.state == State.HOLDING
    assert not bench.stream.limiter.offset_in_base.any()


@pytest.mark.parametrize(("taken", "armed"), [(None, True), (0.03, True), (0.21, False)])
def test_a_long_way_to_the_controller_is_refused_at_arming(
    bench: Bench, taken: float | None, armed: bool
) -> None:
    bench.writing.release()
    bench.supervisor.state = State.ARMED
    bench.driver.taken = taken
    bench.writing.start(bench.state(), Q)
    assert bench.writing.ready == armed
    # after a refusal it counts no more: states would never be fresh enough to arm again
    assert bench.writing.transit_time == ((taken or 0.0) if armed else 0.0)
    assert (bench.supervisor.state == State.ARMED) == armed
    if not armed:
        assert bench.changes[-1][1].startswith("link: a question and its answer take 210 ms")


def tcp_of(q: np.ndarray) -> np.ndarray:
    return MODEL.rigid_pose(q[None]).position[0]


def test_faults_and_armings_in_turn_do_not_add_up(bench: Bench) -> None:
    """The arm is left at its offset each time; what its program wanted stays where it was."""
    shifts = []
    for _ in range(4):
        bench.cycles(700)
        shifts.append(np.linalg.norm(tcp_of(bench.driver.sent[-1]) - tcp_of(Q)))
        bench.supervisor.take(Cause.SILENCE)
        bench.writing.release()
        assert bench.supervisor.state == State.FAULT
        bench.q = bench.driver.sent[-1].copy()
        bench.rearm()
    assert shifts[0] > 1e-4
    assert shifts == pytest.approx([shifts[0]] * 4, rel=1e-3)


def test_each_motion_has_its_own_time_to_settle(bench: Bench) -> None:
    def settles(away: float) -> bool:
        bench.supervisor.state = State.HOLDING
        state = bench.state()
        setpoint = bench.writing.write(state, bench.q, bench.loads.update(state))
        assert setpoint is not None
        assert bench.stream.at_rest
        return bench.writing.at_rest(setpoint, state._replace(target_q=setpoint.q + away))

    bench.supervisor.state = State.HOLDING
    bench.cycles(2000)
    assert not settles(1e-3)
    bench.supervisor.state = State.FAULT
    bench.writing.release()
    CLOCK.sleep(2.0 * SETTLING_TIMEOUT)
    bench.rearm()
    bench.supervisor.state = State.HOLDING
    bench.cycles(2000)
    assert not settles(1e-3)  # the time of the motion before does not count
    assert settles(0.0)


def test_a_beginning_with_an_offset_in_force_makes_no_step(bench: Bench) -> None:
    bench.cycles(100)  # in the middle of the ramp
    bench.supervisor.take(Cause.SILENCE)
    bench.writing.release()
    bench.q = bench.driver.sent[-1].copy()
    bench.rearm()
    bench.cycles(700)
    joints = np.array(bench.driver.sent)
    steps = np.linalg.norm(np.diff([tcp_of(q) for q in joints], axis=0), axis=1)
    assert steps.max() <= 0.05 * T * 1.01


def test_an_offset_in_force_beyond_a_narrowed_envelope_ramps_in_and_is_not_refused(
    bench: Bench,
) -> None:
    """Neither the limiter nor the gate makes the arm stay, or jump, because a cell was edited."""
    bench.cycles(700)
    left = float(np.linalg.norm(bench.stream.limiter.offset_in_base[:3]))
    bench.supervisor.take(Cause.SILENCE)
    bench.writing.release()
    bench.q = bench.driver.sent[-1].copy()
    narrow = left / 3
    limiter, gate = bench.stream.limiter, bench.driver.gate
    limiter._block[0] = narrow  # a reload makes another stream: the same limiter, narrower
    gate.set_bounds(replace(gate.bounds, offset=narrow))
    bench.rearm()
    begin = len(bench.driver.sent)
    bench.cycles(700)
    joints = np.array(bench.driver.sent)[begin - 1 :]
    assert len(joints) == 701
    steps = np.linalg.norm(np.diff([tcp_of(q) for q in joints], axis=0), axis=1)
    assert steps.max() <= 0.05 * T * 1.01
    assert bench.supervisor.state == State.COMPENSATING
    assert np.linalg.norm(limiter.offset_in_base[:3]) <= narrow * (1.0 + 1e-9)


def test_an_offset_in_force_that_no_arm_can_have_is_refused(bench: Bench) -> None:
    bench.cycles(10)
    bench.supervisor.take(Cause.SILENCE)
    bench.writing.release()
    bench.writing._in_force.note(bench.q, np.full(6, 3.0), np.zeros(6))
    bench.supervisor.state = State.ARMED
    sent = len(bench.driver.sent)
    for _ in range(2):
        bench.writing.start(bench.state(), bench.q)
    assert not bench.supervisor.state.writes
    assert "joint offset: found 3, expected at most 0.5" in str(bench.changes[-1])
    assert len(bench.driver.sent) == sent


def test_an_arm_that_somebody_has_moved_begins_without_an_offset(bench: Bench) -> None:
    bench.cycles(700)
    bench.supervisor.take(Cause.SILENCE)
    bench.writing.release()
    bench.q = bench.driver.sent[-1] + 0.1
    bench.rearm()
    bench.cycles(1)
    assert bench.driver.sent[-1] == pytest.approx(bench.q, abs=1e-5)
    assert np.linalg.norm(bench.stream.limiter.offset_in_base) < 1e-5


def test_an_offset_in_force_outlives_the_process_that_left_it(tmp_path: Path) -> None:
    path = tmp_path / "arm.offset"
    delta, offset = np.full(6, 1e-3), np.full(6, 2e-3)
    code = (
        "import sys, os, numpy as np; from pathlib import Path\n"
        "from gapbridge.bridge.loop.offset_in_force import OffsetInForce\n"
        f"kept = OffsetInForce(6, Path({str(path)!r}))\n"
        "for k in range(5): kept.note(np.full(6, 0.1 * k), np.full(6, 1e-3), np.full(6, 2e-3))\n"
        "os.kill(os.getpid(), 9)\n"
    )
    paths = os.pathsep.join(p for p in sys.path if p)
    subprocess.run([sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": paths})
    kept = OffsetInForce(6, path)
    found = kept.offset_at(np.full(6, 0.4))
    assert found is not None
    assert (found.delta == delta).all() and (found.offset_in_base == offset).all()
    assert kept.offset_at(np.full(6, 0.3)) is None
    assert path.stat().st_mode & 0o777 == 0o600
    kept.note(np.full(6, 0.4), np.zeros(6), np.zeros(6))
    assert kept.offset_at(np.full(6, 0.4)) is None
    assert OffsetInForce(7, path).offset_at(np.zeros(7)) is None  # another arm


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="the system reserves no space")
def test_the_place_of_an_offset_in_force_is_reserved_or_refused_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "arm.offset"
    size = 8 * (1 + 2 * (2 * 6 + 6))
    with path.open("wb") as hole:
        hole.truncate(size)
    kept = OffsetInForce(6, path)
    assert path.stat().st_size == size
    assert 512 * path.stat().st_blocks >= size
    assert kept.offset_at(Q) is None

    def is_full(*_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", is_full)
    with pytest.raises(InputError, match=r"arm\.offset: .* cannot be kept: No space left"):
        OffsetInForce(6, path)
    with pytest.raises(InputError, match="none/arm"):
        OffsetInForce(6, tmp_path / "none" / "arm.offset")


def test_a_clock_that_goes_back_withdraws_the_offset_step_by_step(bench: Bench) -> None:
    bench.cycles(700)
    offset = [bench.stream.limiter.offset_in_base]
    assert np.linalg.norm(offset[0]) > 1e-4
    bench.supervisor.take(Cause.IMPLAUSIBLE)  # what the watch over states makes of it
    bench.at -= 5.0
    bench.driver.gate.set_clock(CLOCK.monotonic)
    for _ in range(700):
        bench.cycles(1)
        offset.append(bench.stream.limiter.offset_in_base)
    assert bench.supervisor.state == State.HOLDING
    assert not offset[-1].any()
    assert np.linalg.norm(np.diff(offset, axis=0)[:, :3], axis=1).max() <= 0.05 * T * 1.001


def test_what_the_gate_refuses_holds_and_then_is_a_fault(bench: Bench) -> None:
    """The limiter's memory is written over: nothing of it leaves."""
    bench.cycles(50)
    sent = len(bench.driver.sent)
    limiter = bench.stream.limiter
    limiter._q[:] = Q + 0.3
    limiter.limits.__dict__["following"] = 10.0
    bench.cycles(1)
    assert len(bench.driver.sent) == sent
    assert bench.supervisor.state == State.HOLDING
    bench.cycles(1)
    assert bench.supervisor.state == State.FAULT
    assert len(bench.driver.sent) == sent
    assert bench.count("setpoint_refused") == 2
