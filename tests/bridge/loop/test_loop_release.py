"""The driver is armed only while the loop writes or is about to: in all other states it is not."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clock_by_hand import ByHand

from gapbridge.bridge.cell.run_settings import read_configuration
from gapbridge.bridge.ipc.command_memory import Command
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.loop.loop import STOP_TIMEOUT, Exit, Loop
from gapbridge.bridge.loop.setpoint_stream import longest_ramp_out
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.bridge.setpoint_source.source import Source, SourceContext
from gapbridge.core.errors import RobotBusyError, WriteError
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.driver import Driver

Q = np.array([0.0, -1.5, 1.8, -1.87, -1.57, 0.0])
RATE = 500.0
LONGEST_STOP = 2000  # cycles from a request to stop until a test gives up
CELL = """robot: {model: ur10e}
compliance: {axial: [1.0e-6, 1.0e-6, 1.0e-6, 1.0e-6, 1.0e-6, 1.0e-6]}
payload: {mass: 5.0, cog: [0, 0, 0.06]}
link: {driver: ur_rtde, host: 127.0.0.1}
"""


class StandingArm(Driver):
    """An arm that stands still and reports ``safety_mode``; notes arming and releasing."""

    def __init__(self, model: Any) -> None:
        super().__init__(RATE, model, clock=ByHand())
        self.noted: list[str] = []
        self.safety_mode = 1
        self.q, self.speed = Q, 0.0  # rad and rad/s, reported

    def connect(self) -> None: ...

    def _read_state(self) -> RobotState:
        self.clock.sleep(1.0 / RATE)
        now, still = self.clock.monotonic(), np.zeros(6)
        return RobotState(
            now, now, self.q, still + self.speed, Q, still, safety_mode=self.safety_mode
        )

    def _make_ready(self, state: RobotState) -> None:
        self.noted.append("armed")

    def _send(self, setpoint: Setpoint) -> None: ...

    def _release(self) -> None:
        self.noted.append("released")

    def close(self) -> None: ...


class Waiting(Source):
    """A source whose first setpoint comes when it is told so."""

    ready = True
    discarded = 0

    def discard(self) -> None:
        self.discarded += 1

    def first(self, robot_q: np.ndarray) -> np.ndarray | None:
        return Q if self.ready else None

    def sample(self, timestamp: float, robot_q: np.ndarray) -> np.ndarray:
        return Q


class Asked:
    """Commands by cycle, which is their number, too; the loop is to stop after the last.

    A pair is a command and the number under which it was made earlier.
    """

    stop, beats = False, 0
    last_taken = 0

    def __init__(self, loop: Loop, script: dict[int, Any], cycles: int) -> None:
        self._loop, self._script, self._cycles = loop, script, cycles
        self._cycle = 0
        self._numbers = dict.fromkeys(Command, 0)

    def number_of(self, command: Command) -> int:
        return self._numbers[command]

    def take(self) -> list[Command]:
        self._cycle += 1
        self.stop = self._cycle > self._cycles
        assert self._cycle < self._cycles + LONGEST_STOP, "the loop does not end"
        found = self._script.get(self._cycle)
        if callable(found):
            found()
            return []
        if found is None:
            return []
        command, number = found if isinstance(found, tuple) else (found, self._cycle)
        self._numbers[command] = number
        return [command]


class Bench:
    """A loop on an arm that stands, and what is asked of it."""

    def __init__(self, folder: Path, memory: SharedMemory) -> None:
        cell = folder / "cell.yaml"
        cell.write_text(CELL)
        configuration = read_configuration(cell)
        settings = configuration.settings
        self.driver = StandingArm(configuration.model)
        self.source = Waiting(SourceContext(settings.setpoints, 6, True, folder, RATE, SYSTEM))
        self.events: list[dict[str, Any]] = []
        emit = self.events.append
        self.loop = Loop(settings, configuration.model, self.driver, self.source, memory, emit)

    def run(self, script: dict[int, Any], cycles: int = 120) -> Exit:
        """Run for ``cycles`` with requests, or calls, before the cycles that ``script`` names."""
        asked: Any = Asked(self.loop, script, cycles)
        return self.loop.run(asked, may_write=True)

    def causes(self) -> list[str]:
        return [event["cause"] for event in self.events if event["kind"] == "transition"]


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    memory = SharedMemory(6, clock=SYSTEM)
    yield Bench(tmp_path, memory)
    memory.close()


def test_disarmed_before_the_first_setpoint_the_driver_is_released(bench: Bench) -> None:
    """Else the drives stay enabled, and the next arming skips every check."""

    def goes_silent() -> None:
        bench.source.ready = False

    def speaks_again() -> None:
        bench.source.ready = True

    script = {
        10: Command.ARM,
        11: goes_silent,  # the driver is armed
        12: Command.DISARM,
        30: speaks_again,
        40: Command.ARM,
    }
    bench.run(script)
    assert bench.driver.noted == ["armed", "released", "armed", "released"]
    assert bench.causes()[:6] == ["connected", "arm", "disarm", "arm", "writing", "stop"]


def test_a_fault_releases_the_driver_once_and_ends_when_it_is_acknowledged(bench: Bench) -> None:
    """Else the drives without a fault stay enabled, and none of them is ready any more."""

    def stops() -> None:
        bench.driver.safety_mode = 3

    def is_fine() -> None:
        bench.driver.safety_mode = 1
        assert bench.driver.noted == ["armed", "released"]

    bench.run({10: Command.ARM, 40: stops, 60: is_fine, 70: Command.DISARM})
    assert bench.driver.noted == ["armed", "released"]
    assert bench.causes()[-2:] == [Cause.UNSAFE, Cause.ACKNOWLEDGED]


@pytest.mark.parametrize(("made", "acknowledged"), [(9, False), (11, True)])
def test_a_disarming_that_was_made_before_a_slip_does_not_acknowledge_it(
    bench: Bench, made: int, acknowledged: bool
) -> None:
    bench.run({10: Command.ZERO_MOVED, 12: (Command.DISARM, made), 40: Command.ARM})
    refused = [event["detail"] for event in bench.events if event["kind"] == "refused"]
    assert refused == [] if acknowledged else "zero has moved" in refused[0]
    assert ("writing" in bench.causes()) == acknowledged


def test_only_who_disarms_an_arm_that_is_not_armed_acknowledges_what_stands_still(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    states: list[State] = []

    def note() -> None:
        states.append(bench.loop._supervisor.state)

    monkeypatch.setattr(bench.loop._checks, "acknowledge", note)
    bench.run({10: Command.RAMP_OUT, 20: Command.ARM, 60: Command.RAMP_OUT, 120: Command.DISARM})
    assert states == [State.OBSERVING] * 2
    assert Cause.RAMPED_OUT in bench.causes()


def test_what_came_before_the_driver_was_armed_is_dropped(bench: Bench) -> None:
    found = []

    def note() -> None:
        found.append(bench.source.discarded)

    bench.run({9: note, 10: Command.ARM, 12: note})
    assert found[1] == found[0] + 2  # armed by a person; then the driver, which takes its time


def test_a_release_that_fails_in_a_fault_is_reported(bench: Bench) -> None:
    def stops() -> None:
        bench.driver.safety_mode = 3

    def fail() -> None:
        raise WriteError("no answer")

    bench.driver._release = fail  # type: ignore[method-assign]
    bench.run({10: Command.ARM, 40: stops})
    assert bench.loop._supervisor.state == State.FAULT


@pytest.mark.parametrize("fault", ["busy", "unanswered"])
def test_a_stop_whose_ramp_cannot_end_ends_at_its_deadline(bench: Bench, fault: str) -> None:
    """Else a robot that takes no more setpoints keeps the process for ever."""
    driver, stopped = bench.driver, []

    def busy(setpoint: Setpoint) -> None:
        raise RobotBusyError("busy")

    def takes_no_more() -> None:
        stopped.append(driver.clock.monotonic())
        if fault == "busy":
            driver._send = busy  # type: ignore[method-assign]
        else:
            since = driver.clock.monotonic() - 10.0
            driver.unanswered_since = lambda: since  # type: ignore[method-assign]

    assert bench.run({10: Command.ARM, 120: takes_no_more}) == Exit.DONE
    taken = driver.clock.monotonic() - stopped[0]
    longest = STOP_TIMEOUT + longest_ramp_out(bench.loop._settings.limits)
    assert longest <= taken < longest + 0.05  # not before the ramp could have ended
    assert driver.noted == ["armed", "released"]
    assert bench.events[-1]["detail"] == "not at rest in time"


def test_a_first_setpoint_far_from_the_arm_is_refused_before_the_driver_is_armed(
    bench: Bench,
) -> None:
    bench.source.first = lambda robot_q: Q + 0.2  # type: ignore[method-assign]
    bench.run({10: Command.ARM})
    assert bench.causes() == ["connected", "arm", "start refused"]
    assert bench.driver.noted == []
    detail = bench.events[-1]["detail"]
    assert detail.startswith("joint 1: found the first setpoint 0.2000 rad from the arm")


def test_frozen_joints_are_not_armed_until_they_move(bench: Bench) -> None:
    def moves() -> None:
        bench.driver.q = Q + 1e-4

    bench.driver.speed = 0.1  # rad/s reported, and the joints bit-identical
    bench.run({800: Command.ARM, 900: moves, 902: Command.ARM}, 1000)
    refused = [e["detail"] for e in bench.events if e["kind"] == "refused"]
    assert len(refused) == 1
    assert "joints have been bit-identical for" in refused[0]
    assert bench.causes()[:3] == [Cause.CONNECTED, Cause.ARM, Cause.WRITING]
