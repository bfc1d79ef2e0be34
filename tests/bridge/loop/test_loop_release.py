"""The driver is armed only while the loop writes or is about to: in all other states it is not."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gapbridge.bridge.cell.run_settings import read_configuration
from gapbridge.bridge.ipc.command_memory import Command
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.loop.loop import Loop
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.bridge.setpoint_source.source import Source
from gapbridge.core.errors import WriteError
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import SYSTEM, Clock
from gapbridge.drivers.driver import Driver

Q = np.array([0.0, -1.5, 1.8, -1.87, -1.57, 0.0])
RATE = 500.0
CELL = """robot: {model: ur10e}
compliance: {axial: [1.0e-6, 1.0e-6, 1.0e-6, 1.0e-6, 1.0e-6, 1.0e-6]}
payload: {mass: 5.0, cog: [0, 0, 0.06]}
link: {driver: ur_rtde, host: 127.0.0.1}
"""


class ByHand(Clock):
    """A clock that goes on where somebody sleeps."""

    def __init__(self) -> None:
        self.now = 100.0
        self.monotonic = self.time = lambda: self.now
        self.sleep = self._pass

    def _pass(self, seconds: float) -> None:
        self.now += seconds


class StandingArm(Driver):
    """An arm that stands still and reports ``safety_mode``; notes arming and releasing."""

    def __init__(self, model: Any) -> None:
        super().__init__(RATE, model, clock=ByHand())
        self.noted: list[str] = []
        self.safety_mode = 1

    def connect(self) -> None: ...

    def _read_state(self) -> RobotState:
        self.clock.sleep(1.0 / RATE)
        now, still = self.clock.monotonic(), np.zeros(6)
        return RobotState(now, now, Q, still, Q, still, safety_mode=self.safety_mode)

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
    """Commands by cycle; the loop is to stop after the last."""

    stop = False
    last_taken = 0

    def __init__(self, loop: Loop, script: dict[int, Any], cycles: int) -> None:
        self._loop, self._script, self._cycles = loop, script, cycles
        self._cycle = 0

    def take(self) -> list[Command]:
        self._cycle += 1
        self.stop = self._cycle > self._cycles
        found = self._script.get(self._cycle)
        if callable(found):
            found()
            return []
        return [] if found is None else [found]


class Bench:
    """A loop on an arm that stands, and what is asked of it."""

    def __init__(self, folder: Path, memory: SharedMemory) -> None:
        cell = folder / "cell.yaml"
        cell.write_text(CELL)
        configuration = read_configuration(cell)
        settings = configuration.settings
        self.driver = StandingArm(configuration.model)
        self.source = Waiting(settings.setpoints, 6, True, folder, RATE)
        self.events: list[dict[str, Any]] = []
        emit = self.events.append
        self.loop = Loop(settings, configuration.model, self.driver, self.source, memory, emit)

    def run(self, script: dict[int, Any], cycles: int = 120) -> None:
        """Run for ``cycles`` with requests, or calls, before the cycles that ``script`` names."""
        self.loop.run(Asked(self.loop, script, cycles), may_write=True)  # type: ignore[arg-type]

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
