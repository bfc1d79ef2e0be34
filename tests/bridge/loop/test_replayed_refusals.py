"""Replay of what seldom happens: setpoints refused or sent in part, gaps, a sensor that is lost."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
from clock_by_hand import ByHand
from test_replayed_loop import assert_same_bits

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.bridge.cell.settings.recording import RecordingSettings
from gapbridge.bridge.ipc.command_memory import Command, CommandMemory, Commands
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.loop.loop import Exit, Loop
from gapbridge.bridge.loop.main import _compile
from gapbridge.bridge.loop.replay import ReplayedLoop
from gapbridge.bridge.recording.recorder import Recorder
from gapbridge.bridge.setpoint_source.source import SourceContext
from gapbridge.bridge.setpoint_source.target import TargetSource
from gapbridge.core.errors import GateError, LinkError, PartialWriteError
from gapbridge.core.log.mcap_reading import read_columns
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.replay.driver import ReplayDriver
from gapbridge.drivers.replay.settings import ReplaySettings

N = 6
CELL = """\
robot: {model: ur5e}
compliance: {axial: [8e-6, 8e-6, 8e-6, 8e-6, 8e-6, 8e-6], radial: [0, 0, 0, 0, 0, 0]}
"""
HOME = np.array([0.3, -1.2, 1.4, -0.6, 0.4, 0.2])


class Scripted(Driver):
    """A controller whose own program swings the arm, with mishaps at known cycles."""

    def __init__(self, cycles: int, commands: CommandMemory, model: Model) -> None:
        self._time = ByHand()  # the script's
        super().__init__(20.0, model, moves_arm=False, clock=self._time)
        self._count = iter(range(cycles))
        self._commands = commands
        self._writes = itertools.count(1)
        self._random = np.random.default_rng(3)
        self._cycle, self._lapses, self.refused_at = 0, False, -1

    def connect(self) -> None:
        pass

    def close(self) -> None:
        pass

    def _read_state(self) -> RobotState:
        k = next(self._count, None)
        if k is None:
            raise LinkError("the script has come to its end")
        self._cycle = k
        if k in (700, 1500):
            self._commands.ask(Command.DISARM)
        if k in (20, 900):
            self._commands.ask(Command.ARM)
        t = 0.002 * k + (3.0 if k > 1300 else 0.0)  # a gap
        self._time.now = 100.0 + t
        q = HOME + 0.2 * np.sin(t + np.arange(N))
        target = q + (0.1 if 400 <= k < 402 else 0.0)  # a jump
        force = self._random.normal(0.0, 8.0, 6)
        lost = "unplugged" if 1000 <= k < 1050 else ""
        return RobotState(
            timestamp=t, received=self._time.now, actual_q=q, actual_qd=np.zeros(N),
            target_q=target, actual_TCP_force=np.full(6, np.nan) if lost else force, payload=4.0,
            payload_cog=np.array([0.0, 0.0, 0.06]), sensor_lost=lost,
        )  # fmt: skip

    def _send(self, setpoint: Setpoint) -> None:
        count, self._lapses = next(self._writes), False
        if count % 53 == 0:
            raise PartialWriteError("half of it")
        if self.refused_at < 0 and self._cycle >= 310:
            self.refused_at = self._cycle
            raise GateError("gate: no")
        self._lapses = count % 37 == 0

    def _take_lapsed(self) -> bool:
        lapsed, self._lapses = self._lapses, False
        return lapsed


def run(
    loop: Loop, memory: SharedMemory, commands: CommandMemory, folder: Path, name: str
) -> dict[str, Any]:
    settings = RecordingSettings(folder=folder, keep_free=0.0)
    recorder = Recorder(settings, name, memory, {}, lambda _: None, clock=SYSTEM)
    assert loop.run(Commands(commands.fd), True) in (Exit.LINK, Exit.DONE)
    recorder.close()
    return read_columns(folder / name)


def test_refused_and_half_sent_setpoints_gaps_and_lost_sensors_are_replayed(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(CELL)
    model = load_cell(cell).model
    settings = DaemonSettings(cell=cell)
    memory, commands, events = SharedMemory(N, clock=SYSTEM), CommandMemory(), []
    source = TargetSource(SourceContext(SetpointSettings(), N, False, tmp_path, 20.0, SYSTEM))
    scripted = Scripted(1800, commands, model)
    loop = Loop(settings, model, scripted, source, memory, events.append)
    _compile(settings, model, clock=SYSTEM)  # else the first cycles are late
    then = run(loop, memory, commands, tmp_path, "then")
    flags = then["flags"].astype(int)
    assert {0.0, 1.0, 2.0} == set(then["attempted"])
    refused = (then["attempted"] == 1) & (then["written"] == 0)
    assert refused.any(), events
    assert (flags & 1).any()  # sensor lost
    assert (flags & 4).any()  # gap
    assert (flags & 8).any()  # ramping out
    assert ((flags & 64) > 0).sum() > 10  # after setpoints that have lapsed
    computed = (then["written"] == 1) | (then["attempted"] == 2)
    following = scripted.refused_at + 1 + int(np.argmax(computed[scripted.refused_at + 1 :]))
    assert flags[following] & 64, "after the refused one"
    assert then["written"].sum() > 500

    memory, commands = SharedMemory(N, clock=SYSTEM), CommandMemory()
    driver = ReplayDriver(ReplaySettings(file=tmp_path / "then", speed=100.0), model, clock=SYSTEM)
    again = ReplayedLoop(settings, model, driver, source, memory, lambda _: None)
    assert_same_bits(run(again, memory, commands, tmp_path, "again"), then, len(then["number"]))
