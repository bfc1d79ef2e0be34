"""A daemon that is to stop ends its loop at a deadline, and says how the run went."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from gapbridge.bridge.cell.run_settings import read_configuration
from gapbridge.bridge.daemon.daemon import STOP_MARGIN, TICK, Daemon
from gapbridge.bridge.daemon.processes import LoopProcess
from gapbridge.bridge.ipc.command_memory import Command, CommandMemory
from gapbridge.bridge.ipc.shared_memory import Phase, RunMemory, SharedMemory
from gapbridge.bridge.loop.loop import STOP_TIMEOUT
from gapbridge.bridge.loop.setpoint_stream import longest_ramp_out
from gapbridge.drivers.clock import Clock

CELL = """robot: {model: ur10e}
link: {driver: ur_rtde, host: 192.0.2.7}
"""
BEGIN, ASKED, GIVEN_UP = 100.0, 101.0, 160.0  # s: a stop is asked for; the test gives up


class ByHand(Clock):
    """A clock that goes on where somebody waits; at ASKED ``act`` is called."""

    def __init__(self) -> None:
        self.now = BEGIN
        self.act = lambda: None
        self.monotonic = self.time = lambda: self.now
        self.sleep = self._pass

    def _pass(self, seconds: float) -> None:
        before, self.now = self.now, self.now + seconds
        if before < ASKED <= self.now:
            self.act()
        assert self.now < GIVEN_UP, "the daemon does not end"

    def wait(self, event: threading.Event, seconds: float) -> bool:
        self._pass(seconds)
        return event.is_set()


class Deaf(LoopProcess):
    """A loop whose heart beats and which does not stop."""

    pid = 1
    killed = False

    def __init__(
        self, configuration: Any, memory: RunMemory, commands: CommandMemory, *given: Any
    ) -> None:
        memory.renew()
        self.memory, self._commands, self._settings = memory, commands, configuration.settings
        self._now, self.started = given[-1].monotonic, given[-1].monotonic()
        self.own = SharedMemory(memory.n, memory.fd, clock=given[-1])
        self.own.enter(Phase.RUNNING)

    @property
    def exit_code(self) -> int | None:
        self.own.beat()
        return -9 if self.killed else None

    def events(self) -> list[dict[str, Any]]:
        return []

    def kill(self) -> None:
        self.killed = True

    def close(self) -> None:
        self.kill()


class Stopped(Daemon):
    """A daemon without locks, sockets and side processes."""

    loop_process = Deaf

    def _open(self, stack: ExitStack, arm: bool, by: str) -> bool:
        return arm


def test_a_loop_that_does_not_stop_is_killed_at_the_deadline(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(CELL)
    configuration, clock = read_configuration(cell), ByHand()
    daemon = Stopped(configuration, may_write=True, clock=clock)
    clock.act = daemon.stop
    summary = daemon.run()
    own = STOP_TIMEOUT + longest_ramp_out(configuration.settings.limits)  # the loop's deadline
    assert own + STOP_MARGIN < clock.now - ASKED < own + STOP_MARGIN + 5 * TICK
    assert daemon._commands.last_of(Command.STOP)
    assert summary.exit_code == 1
    assert summary.faults == (f"the loop has not stopped within {own + STOP_MARGIN:.1f} s: killed",)
