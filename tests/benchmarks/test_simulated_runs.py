"""Runs in simulated time: nothing that must hold is broken; and what is broken is found.

``make simulate SEEDS=100000`` runs more of them; a seed that fails is one line to run again.
"""

from __future__ import annotations

import gc
import math
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from benchmarks.simulation import processes
from benchmarks.simulation.faults import ALL
from benchmarks.simulation.invariants import INVARIANTS, as_markdown
from benchmarks.simulation.sequence import LINKS, Outcome, plan_of, run
from gapbridge.bridge.daemon import daemon as daemon_module
from gapbridge.bridge.daemon import owner_lock
from gapbridge.bridge.daemon.control import Control
from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.daemon.processes import LoopProcess
from gapbridge.bridge.daemon.reload import Reload
from gapbridge.bridge.daemon.status import DaemonStatus
from gapbridge.bridge.ipc.command_memory import Command, Commands
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.loop import checks, link_monitor
from gapbridge.bridge.loop.link_monitor import ControllerClock, LinkMonitor
from gapbridge.bridge.loop.loop import Loop
from gapbridge.bridge.loop.supervisor import Cause, Supervisor
from gapbridge.bridge.recording import segment
from gapbridge.bridge.recording.recorder import Recorder
from gapbridge.bridge.recording.segment import Segment
from gapbridge.core.errors import StaleStateError
from gapbridge.core.state import Setpoint
from gapbridge.drivers.can.driver import CanDriver
from gapbridge.drivers.can.profile import JointMap
from gapbridge.drivers.can.reader import FrameReader
from gapbridge.drivers.can.writer import FrameWriter
from gapbridge.drivers.canopen import driver as canopen_driver
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.ft_sensor.joined import SensorReader
from gapbridge.drivers.modbus import encode
from gapbridge.drivers.modbus.driver import ModbusDriver
from gapbridge.drivers.modbus.write import TargetWriter
from gapbridge.drivers.ur_rtde.command import OffsetWriter, ServoWriter
from gapbridge.drivers.ur_rtde.driver import UrRtdeDriver
from gapbridge.drivers.ur_rtde.state import StateReader

DOCS = Path(__file__).parents[2] / "docs" / "evidence" / "fault-method.md"
SEEDS, PART = 2000, 50  # of all tests together, of one
DRAWN = 3000  # seeds whose faults are only drawn
SERVOJ, OFFSET, MODBUS, CAN, CANOPEN, SENSOR, ODRIVE, OPENARM, TARGET = range(9)  # seeds of links
SIGNS = [
    ("mode", SERVOJ, "robot not ready"), ("mode", OFFSET, "robot not ready"),
    ("mode", MODBUS, "robot not ready"), ("mode", CAN, "robot not ready"),
    ("robot's program paused", SERVOJ, "control script has ended"),
    ("robot's program paused", OFFSET, "robot not following"),
    ("robot's program paused", MODBUS, "do not arrive"),
    ("remote control off", SERVOJ, "start refused"),
    ("wrong requests", OFFSET, "do not arrive"), ("wrong requests", MODBUS, "do not arrive"),
    ("error frames", CAN, "COMPENSATING"),
    ("flood of frames", CAN, "COMPENSATING"),
    ("error frames", CANOPEN, "COMPENSATING"), ("flood of frames", CANOPEN, "COMPENSATING"),
    ("mode", CANOPEN, "robot not ready"), ("mode", SENSOR, "robot not ready"),
    ("remote control off", SENSOR, "start refused"),
    ("cell file read again", OFFSET, "was not taken"),
    ("cell file read again", CAN, "offset saturated"),
    *(("daemon dies", link, "did not end in order") for link in range(len(LINKS))),
    *(("daemon started anew", link, "requested by the cell file") for link in range(len(LINKS))),
    *((fault, MODBUS, "COMPENSATING") for fault in ("disk full", "recorder dies", "power cut")),
    ("calendar set", OFFSET, "COMPENSATING"),
    ("drift of the controller's cycle", CAN, "COMPENSATING"),
    *(("mode", link, "robot not ready") for link in (ODRIVE, OPENARM)),
    *((fault, link, "COMPENSATING") for fault in ("error frames", "flood of frames")
      for link in (ODRIVE, OPENARM)),
    ("mode", TARGET, "robot not ready"),
    *(("another commander", link, "another commander") for link in (CAN, ODRIVE, OPENARM)),
]  # fmt: skip
"""What the daemon says where a fault happens, with one of some seeds."""
Patch = pytest.MonkeyPatch
Break = Callable[[Patch], None]


def when_four(seed: int) -> Outcome:
    """Return the run that a seed was when there were the first four links only."""
    return run(seed, later=False, on=list(LINKS)[seed % 4])


def when_six(seed: int) -> Outcome:
    """Return the run that a seed was when there were the first six links only."""
    return run(seed, on=list(LINKS)[seed % 6])


@pytest.mark.parametrize("first", range(0, SEEDS, PART))
def test_what_must_hold_holds_whatever_goes_wrong(first: int) -> None:
    found = [run(seed) for seed in range(first, first + PART)]
    assert not [str(outcome) for outcome in found if outcome.violations]
    assert sum(outcome.writes for outcome in found) > 50 * len(found)


def test_a_run_leaves_nothing_open() -> None:
    def held() -> int:
        gc.collect()
        return len(os.listdir("/proc/self/fd"))

    plan = [(0.1, "recorder dies"), (0.4, "daemon dies"), (0.8, "disk full")]
    run(0, plan=plan)
    before = held()
    for seed in range(1, 4):
        run(seed)
        run(seed, plan=plan)
    assert held() <= before


def test_a_seed_is_the_same_run_each_time() -> None:
    first, second = list[str](), list[str]()
    assert str(run(5, first.append)) == str(run(5, second.append))
    assert first == second
    assert len(first) > 5


@pytest.mark.parametrize("link", LINKS)
def test_a_run_without_faults_compensates_on_every_link(link: str) -> None:
    outcome = run(list(LINKS).index(link), plan=[])
    assert not outcome.violations
    assert outcome.writes > (3 if link == "modbus_target" else 30)  # no target while it moves
    assert outcome.oldest < 0.04


def test_every_fault_can_happen_on_some_link() -> None:
    assert all(fault.links for fault in ALL)
    assert {link for fault in ALL for link in fault.links} == set(LINKS)


def test_every_family_is_among_the_first_seeds() -> None:
    """On each link that has it; what it comes to, the tests below and the breaks show."""
    drawn = Counter[tuple[str, str]]()
    for seed in range(DRAWN):
        link = list(LINKS)[seed % len(LINKS)]
        drawn.update((fault.name, link) for _, fault in plan_of(seed))
    assert not [(f.name, link) for f in ALL for link in f.links if not drawn[f.name, link]]


@pytest.mark.parametrize(("fault", "link", "sign"), SIGNS)
def test_a_fault_shows(fault: str, link: int, sign: str) -> None:
    plan = [(0.1, fault), (0.3, "disarm"), (0.5, "arm"), (3.0, "arm")]
    said = list[str]()
    for seed in range(link, link + 24 * len(LINKS), len(LINKS)):
        assert not run(seed, said.append, plan).violations
        if any(sign in line for line in said):
            return
    raise AssertionError(said[-20:])


def test_the_page_has_the_list() -> None:
    assert as_markdown() in DOCS.read_text(encoding="utf-8")


@pytest.mark.parametrize("fault", ["loop dies", "daemon dies"])
def test_a_process_dies_at_a_line_of_the_product(fault: str) -> None:
    """They did not for a while: the lines were looked for in folders that had been moved."""
    died = 0
    for seed in range(8):
        said = list[str]()
        found = run(seed, said.append, [(0.1, fault)])
        if "lines on" in found.faults[0]:
            died += 1
            assert sum("OBSERVING connected" in line for line in said) > 1
    assert died


def test_a_disarm_from_before_a_fault_does_not_acknowledge_it() -> None:
    """Seed 98: the loop stood still, somebody asked for disarming, and then the robot stopped."""
    assert not when_four(98).violations
    plan = [(0.1, "machine stalls"), (0.11, "disarm"), (0.12, "protective stop")]
    assert not [str(o) for seed in range(12) if (o := run(seed, plan=plan)).violations]


def test_a_program_that_applies_nothing_after_a_stop_may_be_armed_at_once() -> None:
    """Seed 498: the robot had said so, and who judged counted on the offset's withdrawal."""
    plan = [(0.75, "emergency stop")]
    found = [run(seed, plan=plan) for seed in range(MODBUS, MODBUS + 20, len(LINKS))]
    assert not [str(outcome) for outcome in found if outcome.violations]


def test_the_first_state_after_a_standstill_is_judged_by_the_clock_before_it() -> None:
    """Seed 3385: a state 42 ms old was written by, as if the clocks had drifted apart meanwhile."""
    plan = [(0.1, "machine stalls"), (0.5, "held back"), (0.7, "loop stalls")]
    found = [
        when_four(3385),
        *(run(seed, plan=plan) for seed in range(OFFSET, OFFSET + 24, len(LINKS))),
    ]
    assert not [str(outcome) for outcome in found if outcome.violations]


def test_an_arm_released_in_silence_is_sent_where_it_was_sent_before() -> None:
    """Seed 3243: stopped while the arm was silent; enabling frames say the last joints again."""
    assert not when_four(3243).violations


@pytest.mark.parametrize(("driver", "seed"), [(UrRtdeDriver, SERVOJ), (ModbusDriver, MODBUS)])
def test_a_way_longer_than_a_state_may_be_old_lets_no_setpoint_leave(
    monkeypatch: Patch, driver: type[Driver], seed: int
) -> None:
    assert run(seed, plan=[]).oldest > 0.0
    monkeypatch.setattr(driver, "transit_time", lambda _: 0.11)
    assert run(seed, plan=[]).oldest == 0.0  # no setpoint at all; arming writes too


def test_the_way_is_measured_when_arming_and_counts_as_part_of_each_states_age(
    monkeypatch: Patch,
) -> None:
    plan, found = [(0.1, "disarm"), (0.2, "delay step"), (0.6, "arm")], list[float]()
    transit_time = UrRtdeDriver.transit_time

    def noted(self: Any) -> float:
        found.append(transit_time(self))
        return found[-1]

    monkeypatch.setattr(UrRtdeDriver, "transit_time", noted)
    run(SERVOJ, plan=[])
    assert all(4e-4 <= way < 1e-3 for way in found)  # there and back, 0.2 ms each
    for seed in range(SERVOJ, SERVOJ + 40, len(LINKS)):
        run(seed, plan=plan)
    assert max(found) > 0.01


def test_an_arming_that_a_gap_in_the_states_ends_is_answered() -> None:
    """Seed 2007469: who had asked waited for 25 s, and then read that nobody had answered."""
    assert not when_four(2007469).violations


def test_the_answer_to_a_closed_connection_is_nobodys() -> None:
    """Seed 3000286: a new Modbus connection numbers from one again, and took the old one's."""
    assert not when_four(3000286).violations


@pytest.mark.parametrize("seed", [8248, 8824])  # else arming is refused for good
def test_a_drive_whose_mode_changes_while_the_link_is_lost_arms_after_it_was_off(seed: int) -> None:
    assert not run(seed).violations


@pytest.mark.parametrize("seed", [5005572, 5025157])
def test_a_clock_that_is_set_forward_behind_jitter_makes_no_state_younger(seed: int) -> None:
    assert not when_four(seed).violations


def test_a_clock_set_forward_as_the_next_packet_comes_late_is_no_violation_but_reported(
    monkeypatch: Patch,
) -> None:
    """Seed 5024965: timestamps and arrivals are those of a clock that nobody touched."""
    monkeypatch.setattr(link_monitor, "DRIFT", 5e-3)  # as it was: that run's setpoints leave
    found = when_four(5024965)
    assert not found.violations
    assert found.hidden > 0.05
    assert "undetectable: a setpoint of a state sampled 0.066 s before" in str(found)


def test_a_planner_that_begins_where_an_offset_was_left_is_led_over_no_faster_than_it() -> None:
    assert not when_four(8022740).violations


def test_an_answer_of_zeros_does_not_say_that_no_offset_is_applied() -> None:
    """Seed 7061098: over Modbus, after a loop that died; arming announced a zero into an offset."""
    assert not when_four(7061098).violations


def test_the_first_setpoint_of_a_stream_is_within_the_envelope_whatever_the_model_says() -> None:
    """Seed 5019099: joints 0.5 rad off beside a small offset; the arm went 0.03 rad at once."""
    plan = [(0.1, "disarm"), (0.5, "model no number"), (0.51, "arm")]
    found = [
        when_four(5019099),
        *(run(seed, plan=plan) for seed in range(CAN, CAN + 80, len(LINKS))),
    ]
    assert not [str(outcome) for outcome in found if outcome.violations]


@pytest.mark.parametrize("link", ["ur_servoj", "ur_offset", "ur_sensor", "modbus"])
def test_a_way_that_grows_as_slowly_as_a_clock_drifts_lets_no_state_look_younger(link: str) -> None:
    found = run(0, plan=[(0.1, "delay that grows"), (20.0, "arm")], on=link)
    assert not found.violations


def test_a_way_that_grows_is_found_where_it_is_taken_for_drift(monkeypatch: Patch) -> None:
    monkeypatch.setattr(link_monitor, "DRIFT", 5e-3)
    monkeypatch.setattr(link_monitor, "GROWTH", math.inf)
    found = run(0, plan=[(0.1, "delay that grows"), (20.0, "arm")], on="ur_offset")
    assert {violation.invariant for violation in found.violations} == {"age"}


def test_a_way_that_was_long_when_arming_was_refused_is_measured_anew() -> None:
    """Seed 5026389: it went on counting, so that no state was ever fresh again."""
    plan = [(0.1, "disarm"), (0.2, "delay step"), (0.6, "arm")]
    found = [
        when_four(5026389),
        *(run(seed, plan=plan) for seed in range(OFFSET, OFFSET + 60, len(LINKS))),
    ]
    assert not [str(outcome) for outcome in found if outcome.violations]


# -- each of the list is found where the product is broken -----------------------------------------


def _changed_offsets(change: Callable[[int, np.ndarray], np.ndarray]) -> Break:
    """Have the writer of offsets send others than it is given."""

    def apply(patch: Patch) -> None:
        write, count = OffsetWriter.write, [0]

        def other(self: Any, setpoint: Setpoint, state: Any) -> None:
            count[0] += 1
            offset = change(count[0], setpoint.offset_in_base)
            write(self, setpoint._replace(offset_in_base=offset), state)

        patch.setattr(OffsetWriter, "write", other)

    return apply


def _changed_joints(change: Callable[[int, np.ndarray], np.ndarray]) -> Break:
    """Have the writer of joints send others than it is given."""

    def apply(patch: Patch) -> None:
        write, count = ServoWriter.write, [0]

        def other(self: Any, setpoint: Setpoint, state: Any) -> None:
            count[0] += 1
            write(self, setpoint._replace(q=change(count[0], setpoint.q)), state)

        patch.setattr(ServoWriter, "write", other)

    return apply


def _changed_frames(change: Callable[[int, np.ndarray], np.ndarray]) -> Break:
    """Have the writer of CAN frames send other joints than it is given."""

    def apply(patch: Patch) -> None:
        write, count = FrameWriter.write, [0]

        def other(self: Any, q: np.ndarray) -> None:
            count[0] += 1
            write(self, change(count[0], q))

        patch.setattr(FrameWriter, "write", other)

    return apply


def _jumps_on_the_wire(patch: Patch) -> None:
    to_wire, count = JointMap.to_wire, [0]

    def other(self: Any, q: np.ndarray) -> np.ndarray:
        count[0] += 1
        far = 9.0 if len(q) == 7 else math.nan  # counts are no floats; DH rows have no limits
        return to_wire(self, q) + (far if count[0] == 20 else 0.0)

    patch.setattr(JointMap, "to_wire", other)


def _sends_frames_of_others(patch: Patch) -> None:
    write = FrameWriter.write

    def other(self: Any, q: np.ndarray) -> None:
        write(self, q)
        self._bus.send(can.Message(arbitration_id=0x7F0, is_extended_id=False, data=b"1"))

    patch.setattr(FrameWriter, "write", other)


def _hears_no_stop_on_can(patch: Patch) -> None:
    patch.setattr(checks, "why_not_ready", lambda _: "")
    patch.setattr(FrameReader, "silent_status", lambda _: "")


def _keeps_the_last_sample(patch: Patch) -> None:
    """Return the last sample again where none comes, as if it were new."""
    read = CanDriver._read_state

    def again(self: Any) -> Any:
        soon = self.settings.model_copy(update={"state_timeout": 0.02})
        patch.setattr(self, "settings", soon)
        try:
            self.kept = read(self)
        except StaleStateError:
            now = self._now()
            self.kept = self.kept._replace(timestamp=now, received=now)
        return self.kept

    patch.setattr(CanDriver, "_read_state", again)


def _changed_targets(change: Callable[[int, np.ndarray], np.ndarray]) -> Break:
    """Have the writer of targets in registers send others than it is given."""

    def apply(patch: Patch) -> None:
        write, count = TargetWriter.write, [0]

        def other(self: Any, setpoint: Setpoint, sample: Any, expiry: float) -> None:
            changed = setpoint._replace(q=change(count[0], setpoint.q))
            write(self, changed, sample, expiry)
            count[0] += 1  # of those that have left

        patch.setattr(TargetWriter, "write", other)

    return apply


def _triggers_elsewhere(patch: Patch) -> None:
    write = TargetWriter._write_all

    def other(self: Any, writes: Any, *expiry: float) -> None:
        write(self, writes, *expiry)
        self._transport._client.write_register(200, 1, device_id=1)

    patch.setattr(TargetWriter, "_write_all", other)


def _sees_no_stop_of_targets(patch: Patch) -> None:
    patch.setattr(checks, "why_not_ready", lambda _: "")


def _wrong_checksum(patch: Patch) -> None:
    words = encode.mailbox_words
    patch.setattr(
        encode, "mailbox_words", lambda *given: [*(w := words(*given))[:-1], (w[-1] + 1) % 65521]
    )


def _writes_whenever_it_reads(patch: Patch) -> None:
    read = UrRtdeDriver.read_state

    def eager(self: Any) -> Any:
        writer: Any = self._writer
        if writer._io is not None:
            writer._sequence += 1
            writer._send([20000, 0, 0, 0, 0, 0])
        return read(self)

    patch.setattr(UrRtdeDriver, "read_state", eager)


def _sees_no_stop(patch: Patch) -> None:
    patch.setattr(checks, "why_not_ready", lambda _: "")
    patch.setattr(OffsetWriter, "unanswered_since", lambda _: math.inf)
    patch.setattr(OffsetWriter, "keep_alive", lambda _: None)  # sees the program's end


def _takes_old_states(patch: Patch) -> None:
    """Go on with the last state where none comes, as if it were new."""
    read = StateReader.read

    def again(self: Any) -> Any:
        try:
            self.kept = read(self)
        except StaleStateError:
            self._changed = self._now()
            now = self._now()
            self.kept = self.kept._replace(timestamp=self.kept.timestamp + 0.008, received=now)
        return self.kept

    patch.setattr(StateReader, "read", again)
    patch.setattr(ControllerClock, "expiry", lambda *_: math.inf)
    patch.setattr(LinkMonitor, "accept", lambda *_: True)
    patch.setattr(OffsetWriter, "unanswered_since", lambda _: math.inf)


def _ties_clocks_while_writing(patch: Patch) -> None:
    take = ControllerClock.take
    patch.setattr(ControllerClock, "take", lambda self, state, **_: take(self, state))
    patch.setattr(OffsetWriter, "unanswered_since", lambda _: math.inf)
    patch.setattr(Supervisor, "take", _without(Supervisor.take, Cause.STALE))


def _without(take: Any, cause: Cause) -> Any:
    return lambda self, found, detail="": found != cause and take(self, found, detail)


def _arms_by_itself(patch: Patch) -> None:
    take = Commands.take

    def eager(self: Any) -> list[Command]:
        found = take(self)
        self.eager = getattr(self, "eager", False) or Command.ARM in found
        return found or ([Command.ARM] if self.eager else [])

    patch.setattr(Commands, "take", eager)


def _forgets_faults(patch: Patch) -> None:
    lost = DaemonStatus.lost_loop

    def forgetting(self: Any) -> None:
        lost(self)
        self._fault = ""

    patch.setattr(DaemonStatus, "lost_loop", forgetting)


def _leaves_the_table(patch: Patch) -> None:
    take = Supervisor.take

    def other(self: Any, cause: Cause, detail: str = "") -> bool:
        before = self.state
        if cause == Cause.DISARM and before == State.COMPENSATING:
            self.state = State.OBSERVING
            self._listener(before, State.OBSERVING, cause, detail)
            return True
        return bool(take(self, cause, detail))

    patch.setattr(Supervisor, "take", other)


def _answers_at_once(patch: Patch) -> None:
    for name in ("_wait_for", "_await_observing"):
        patch.setattr(Control, name, lambda *_: True)


def _never_stops(patch: Patch) -> None:
    patch.setattr(LoopProcess, "ask_to_stop", lambda _: None)
    patch.setattr(daemon_module, "STOP_MARGIN", 1e9)


def _fails_at_dropping(patch: Patch) -> None:
    def drop(self: Any, error: Exception) -> None:
        raise KeyError(str(error))

    patch.setattr(LinkMonitor, "drop", drop)


def _records_too_little(patch: Patch) -> None:
    record = Loop._record

    def other(self: Any, given: Any, setpoint: Any, *more: Any, since: float | None = None) -> None:
        record(self, given, setpoint, bool(more), sent=False, since=since)

    patch.setattr(Loop, "_record", other)


def _keeps_faults(patch: Patch) -> None:
    patch.setattr(Loop, "_acknowledge", lambda _: None)


def _ends_at_a_bad_cell_file(patch: Patch) -> None:
    take = Reload._take

    def other(self: Any, *given: Any) -> None:
        take(self, *given)
        self._next = self._next or given[1]  # the one that runs, as if it were new

    patch.setattr(Reload, "_take", other)


def _stays_at_the_limit(patch: Patch) -> None:
    patch.setattr(checks.SaturationWatch, "update", lambda *_: None)


def _keeps_the_last_force(patch: Patch) -> None:
    patch.setattr(SensorReader, "_require_fresh", lambda *_: None)


def _takes_every_end_for_one_in_order(patch: Patch) -> None:
    patch.setattr(owner_lock, "_parsed", lambda _: {})
    _forgets_a_run_at_a_power_cut(patch)


def _forgets_a_run_at_a_power_cut(patch: Patch) -> None:
    mark = processes._Lock._mark
    patch.setattr(processes._Lock, "_mark", lambda lock: mark(lock) and False)


def _notes_no_fault(patch: Patch) -> None:
    patch.setattr(Daemon, "_note_latched", lambda _: None)


def _syncs_nothing(patch: Patch) -> None:
    patch.setattr(Segment, "flush", lambda self: self._writer.flush())


def _forgets_what_the_disk_refused(patch: Patch) -> None:
    pause = Recorder._pause

    def other(self: Any, reason: str) -> None:
        pause(self, reason)
        self._next = self._reader.next

    patch.setattr(Recorder, "_pause", other)


BREAKS: list[tuple[str, int, list[tuple[float, str]], Break]] = [
    ("envelope", OFFSET, [], _changed_offsets(lambda _, offset: 10.0 * offset)),
    ("rate", OFFSET, [], _changed_offsets(lambda i, offset: offset * (i % 7 > 0))),
    ("start", SERVOJ, [], _changed_joints(lambda i, q: q + 0.05)),
    ("limits", SERVOJ, [], _changed_joints(lambda i, q: q * (math.nan if i == 20 else 1.0))),
    ("allowed", MODBUS, [], _wrong_checksum),
    ("state", OFFSET, [(0.1, "disarm")], _writes_whenever_it_reads),
    ("stopped", OFFSET, [(0.1, "protective stop")], _sees_no_stop),
    ("fresh", OFFSET, [(0.1, "controller's clock stands")], _takes_old_states),
    ("age", OFFSET, [(0.1, "delay step")], _ties_clocks_while_writing),
    ("asked", OFFSET, [(0.1, "disarm")], _arms_by_itself),
    ("latched", CAN, [(0.1, "protective stop"), (0.3, "loop dies")], _forgets_faults),
    ("table", OFFSET, [(0.1, "disarm")], _leaves_the_table),
    ("taken", OFFSET, [(0.1, "protective stop")], _answers_at_once),
    ("ends", MODBUS, [], _never_stops),
    ("crash", MODBUS, [(0.1, "corruption")], _fails_at_dropping),
    ("recorded", CAN, [], _records_too_little),
    ("asked", MODBUS, [(0.1, "daemon dies")], _takes_every_end_for_one_in_order),
    ("asked", MODBUS, [(0.1, "power cut")], _forgets_a_run_at_a_power_cut),
    (
        "latched",
        CAN,
        [(0.1, "stop for a moment"), (0.3, "daemon dies"), (1.2, "arm")],
        _notes_no_fault,
    ),
    ("files", OFFSET, [(1.2, "power cut")], _syncs_nothing),
    ("files", OFFSET, [(0.1, "disk full")], _forgets_what_the_disk_refused),
    ("kept", OFFSET, [(0.1, "cell file read again")], _ends_at_a_bad_cell_file),
    (
        "saturated",
        OFFSET,
        [(0.1, "cell file read again"), (0.5, "arm"), (4.0, "arm")],
        _stays_at_the_limit,
    ),
    ("sensor", SENSOR, [(0.1, "FT sensor lost")], _keeps_the_last_force),
    ("recovers", CAN, [(0.1, "protective stop")], _keeps_faults),
]
ON_CAN: list[tuple[str, list[tuple[float, str]], Break]] = [
    ("envelope", [], _changed_frames(lambda i, q: q + 1e-4 * min(i, 100))),
    ("rate", [], _changed_frames(lambda i, q: q + 0.002 * (i % 7 == 6))),
    ("start", [], _changed_frames(lambda i, q: q + 0.05)),
    ("limits", [], _jumps_on_the_wire),
    ("allowed", [], _sends_frames_of_others),
    ("stopped", [(0.1, "mode")], _hears_no_stop_on_can),
    ("fresh", [(0.1, "held back")], _keeps_the_last_sample),
]


@pytest.mark.parametrize(
    ("invariant", "seed", "plan", "breaks"), BREAKS, ids=[f"{b[0]} {b[3].__name__}" for b in BREAKS]
)
def test_a_broken_product_is_found(
    monkeypatch: Patch, invariant: str, seed: int, plan: list[tuple[float, str]], breaks: Break
) -> None:
    breaks(monkeypatch)
    # faults draw their sizes by the seed
    outcomes = (run(seed + more, plan=plan) for more in range(0, 40 * len(LINKS), len(LINKS)))
    assert any(v.invariant == invariant for outcome in outcomes for v in outcome.violations)


@pytest.mark.parametrize("link", ["odrive", "openarm"])
@pytest.mark.parametrize(("invariant", "plan", "breaks"), ON_CAN, ids=[b[0] for b in ON_CAN])
def test_a_broken_driver_is_found_on_each_arm_on_can(
    monkeypatch: Patch, link: str, invariant: str, plan: list[tuple[float, str]], breaks: Break
) -> None:
    breaks(monkeypatch)
    outcomes = (run(seed, plan=plan, on=link) for seed in range(40))
    assert any(v.invariant == invariant for outcome in outcomes for v in outcome.violations)


ON_TARGET: list[tuple[str, list[tuple[float, str]], Break]] = [
    ("envelope", [], _changed_targets(lambda i, q: q + 1e-3 * min(i, 6))),
    ("rate", [], _changed_targets(lambda i, q: q + 0.002 * (i % 3 == 2))),
    ("start", [], _changed_targets(lambda i, q: q + 0.05)),
    ("limits", [], _changed_targets(lambda i, q: q + 9.0 * (i == 3))),
    ("allowed", [], _triggers_elsewhere),
    ("stopped", [(0.1, "mode")], _sees_no_stop_of_targets),
]


@pytest.mark.parametrize(("invariant", "plan", "breaks"), ON_TARGET, ids=[b[0] for b in ON_TARGET])
def test_a_broken_driver_is_found_where_targets_are_triggered(
    monkeypatch: Patch, invariant: str, plan: list[tuple[float, str]], breaks: Break
) -> None:
    breaks(monkeypatch)
    outcomes = (run(seed, plan=plan, on="modbus_target") for seed in range(40))
    assert any(v.invariant == invariant for outcome in outcomes for v in outcome.violations)


def _loses_names(patch: Patch) -> None:
    patch.setattr(segment, "sync_folder", lambda _: None)


def test_a_recording_whose_name_a_power_cut_takes_is_found(monkeypatch: Patch) -> None:
    _loses_names(monkeypatch)
    outcomes = (run(seed, plan=[(1.2, "power cut")], on="ur_offset") for seed in range(12))
    assert any(v.invariant == "files" for outcome in outcomes for v in outcome.violations)


def test_what_waited_for_a_full_disk_at_a_power_cut_is_no_violation() -> None:
    plan = [(0.2, "power cut"), (0.7, "disk full"), (1.5, "power cut")]
    assert not [str(o) for seed in range(6) if (o := run(seed, plan=plan, on="modbus")).violations]
    assert not run(40000194, on="odrive").violations  # its recorder dies as it resumes


def test_each_of_two_questions_that_are_under_way_is_answered_by_a_state() -> None:
    """Seed 40002127: who judged took the answer to the first for one to a command."""
    assert not run(40002127, on="openarm").violations


def test_every_invariant_has_a_break() -> None:
    assert {name for name, *_ in BREAKS} == set(INVARIANTS)


def test_a_stop_that_comes_and_goes_while_frames_are_out_of_order_is_a_fault() -> None:
    found = when_four(8072455)
    assert not found.violations


def test_the_first_state_after_the_loop_stood_still_writes_nothing() -> None:
    """A controller's clock that runs fast meanwhile makes it look younger than it is."""
    assert not when_four(11029317).violations


def test_a_way_that_grows_while_the_driver_is_armed_makes_states_old() -> None:
    """Arming takes 0.3 s on a UR, and the round trip is measured at its begin."""
    assert not when_four(11053496).violations


@pytest.mark.parametrize("more", range(0, 8 * len(LINKS), len(LINKS)))
def test_a_canopen_setpoint_whose_sync_comes_late_never_takes_effect(more: int) -> None:
    """Seeds 46 and 48: the process stood still between a setpoint's frames and its SYNC."""
    plan = [(0.1, "machine stalls"), (0.4, "loop stalls"), (0.7, "machine stalls")]
    assert not run(CANOPEN + more, plan=plan).violations


def test_a_canopen_setpoint_that_may_wait_for_ever_is_found(monkeypatch: Patch) -> None:
    monkeypatch.setattr(canopen_driver, "LONGEST_WAIT", math.inf)
    plan = [(0.1, "machine stalls"), (0.4, "machine stalls"), (0.7, "machine stalls")]
    seeds = range(CANOPEN, 40 * len(LINKS), len(LINKS))  # until a stall is of the right length
    outcomes = (run(seed, plan=plan) for seed in seeds)
    assert any(v.invariant == "fresh" for outcome in outcomes for v in outcome.violations)


def test_a_loop_that_stands_in_its_lock_holds_up_who_hands_it_frames() -> None:
    """Seed 20001832: the run never came to its end."""
    assert not when_six(20001832).violations


def test_a_drives_fault_is_reset_by_arming_where_the_cell_says_so() -> None:
    """Seed 3: the loop refused to arm a robot in fault before the driver could reset it."""
    plan = [(0.1, "drive fault"), (0.3, "loop dies")]
    assert not [
        str(o)
        for more in range(0, 4 * len(LINKS), len(LINKS))
        if (o := run(CANOPEN + more, plan=plan)).violations
    ]


def test_without_the_sensor_nothing_is_written_where_its_loss_stops() -> None:
    plan = [(0.1, "FT sensor lost"), (0.5, "FT sensor's bus lost"), (0.7, "FT sensor overloaded")]
    seeds = range(SENSOR, 20 * len(LINKS), len(LINKS))
    found = [run(seed, plan=plan) for seed in seeds]
    assert not [str(outcome) for outcome in found if outcome.violations]
    words = " ".join(fault for outcome in found for fault in outcome.faults)
    assert "(stop" in words
    assert "(degrade" in words


@pytest.mark.parametrize("seed", [30000491, 31005917, 31000451])
def test_a_sensors_thread_ends_with_its_process_and_nothing_is_stopped_at_the_send(seed) -> None:
    """A thread that outlived its loop took the bus; between check and sending no time shows."""
    assert not when_six(seed).violations


@pytest.mark.parametrize("seed", [12650, 23794, 27923])
def test_an_arm_at_rest_can_be_armed_again_after_a_wrong_command(seed) -> None:
    """Joints that stood still since then counted as frozen for ever."""
    assert not run(seed).violations


@pytest.mark.parametrize("seed", [19781, 20456, 77552])
def test_no_target_is_triggered_that_took_too_long_to_write(seed) -> None:
    assert not run(seed).violations


def test_a_lost_sensor_that_nobody_misses_is_found(monkeypatch: Patch) -> None:
    monkeypatch.setattr(SensorReader, "_require_fresh", lambda *_: None)
    monkeypatch.setattr(SensorReader, "_require_valid", lambda *_: None)
    plan = [(0.1, "FT sensor lost"), (0.5, "FT sensor overloaded")]
    outcomes = [run(seed, plan=plan) for seed in range(SENSOR, 20 * len(LINKS), len(LINKS))]
    assert any(v.invariant == "allowed" for outcome in outcomes for v in outcome.violations)
