"""A stop of the robot is latched also where a write fails before its state is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clock_by_hand import ByHand
from test_replayed_refusals import CELL, HOME, N

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.bridge.daemon.status import DaemonStatus
from gapbridge.bridge.ipc.command_memory import Command, CommandMemory, Commands
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.loop.loop import Exit, Loop
from gapbridge.bridge.loop.main import _compile
from gapbridge.bridge.setpoint_source.source import SourceContext
from gapbridge.bridge.setpoint_source.target import TargetSource
from gapbridge.core.errors import StaleStateError, WriteError
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.robot_modes import MODES, Modes, StopReason

FAILS_AT = 60  # cycle


class Stopping(Driver):
    """A controller that ends its program at a stop, which its next state reports; or is gone."""

    def __init__(self, commands: CommandMemory, model: Model, after: Modes | str):
        self._time = ByHand()  # goes on by a cycle where a state is read
        super().__init__(20.0, model, moves_arm=False, clock=self._time)
        self._commands, self._after, self._cycle = commands, after, 0

    def connect(self) -> None: ...

    def close(self) -> None: ...

    def _read_state(self) -> RobotState:
        self._cycle += 1
        self._time.sleep(0.002)
        if self._cycle == 20:
            self._commands.ask(Command.ARM)
        is_after = self._cycle > FAILS_AT
        if is_after and isinstance(self._after, str):
            raise StaleStateError(self._after)
        q = HOME + 0.1 * np.sin(0.002 * self._cycle + np.arange(N))
        state = RobotState(
            timestamp=0.002 * self._cycle, received=self._time.now, actual_q=q,
            actual_qd=np.zeros(N), target_q=q, actual_TCP_force=np.zeros(6), payload=4.0,
            payload_cog=np.array([0.0, 0.0, 0.06]),
        )  # fmt: skip
        return state._replace(**self._after._asdict()) if is_after else state

    def _send(self, setpoint: Setpoint) -> None:
        if self._cycle >= FAILS_AT:
            raise WriteError("the control script has ended")


@pytest.mark.parametrize(
    ("after", "latched"),
    [
        (MODES[StopReason.PROTECTIVE_STOP], "robot not ready: robot_mode 7, safety_mode 3"),
        (MODES[StopReason.EMERGENCY_STOP], "robot not ready: robot_mode 3, safety_mode 7"),
        (MODES[None], ""),  # a failed write ends with the link
        ("unplugged", ""),
    ],
)
def test_what_stays_latched_after_a_failed_write(
    tmp_path: Path, after: Modes | str, latched: str
) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(CELL)
    model, settings = load_cell(cell).model, DaemonSettings(cell=cell)
    memory, commands = SharedMemory(N, clock=SYSTEM), CommandMemory()
    events: list[dict[str, Any]] = []
    source = TargetSource(SourceContext(SetpointSettings(), N, False, tmp_path, 20.0, SYSTEM))
    loop = Loop(settings, model, Stopping(commands, model, after), source, memory, events.append)
    _compile(settings, model, clock=SYSTEM)  # else the first cycles are late
    assert loop.run(Commands(commands.fd), True) == Exit.LINK
    status = DaemonStatus(memory.slices, SYSTEM)
    for event in events:
        status.on_event({"time": 0.0, **event})
    causes = [event["cause"] for event in events if event["kind"] == "transition"]
    assert "write failed" in causes
    assert causes[-1] == "link lost"
    assert status.latched.startswith(latched)
    assert bool(status.latched) == bool(latched)
    assert memory.counts()["unsafe"] == bool(latched)
