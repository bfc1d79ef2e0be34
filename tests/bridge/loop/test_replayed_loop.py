"""The daemon's loop on a recording of itself: the same offsets, bit for bit."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from daemon_cell import Robot
from numpy.typing import NDArray
from patience import wait_for

from gapbridge.bridge.cell.run_settings import read_configuration
from gapbridge.bridge.cell.settings.recording import RecordingSettings
from gapbridge.bridge.daemon.processes import LoopProcess
from gapbridge.bridge.ipc.command_memory import Command, CommandMemory
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import RunMemory
from gapbridge.bridge.recording.recorder import Recorder
from gapbridge.core.log.mcap_reading import read_columns
from gapbridge.drivers.clock import SYSTEM

COMPARED = (
    "timestamp", "state", "written", "attempted", "nominal_q", "corrected_q", "offset", "residual",
    "clamped", "own_q", "target_q", "actual_q", "actual_qd", "actual_TCP_force", "payload",
    "payload_cog", "ft_raw_wrench", "joint_temperatures", "ramp_time", "rate",
)  # fmt: skip


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    with Robot(tmp_path) as found:
        yield found


class Loops:
    """Processes of the loop on one memory, and a recorder of what they do."""

    def __init__(self, cell: Path, session: str, arm: bool = False) -> None:
        self.configuration = read_configuration(cell)
        self.memory, self.commands = RunMemory(6, clock=SYSTEM), CommandMemory()
        folder = cell.parent / "recordings"
        self.stem = folder / session
        self.recorder = Recorder(
            RecordingSettings(folder=folder, keep_free=0.0),
            session,
            self.memory,
            {},
            lambda _: None,
            clock=SYSTEM,
        )
        self._number = 0
        self.start(arm)

    def start(self, arm: bool) -> None:
        order = {"may_write": True, "number": self._number, "latched": "",
                 "after": self.commands.number()}  # fmt: skip
        if arm:
            self.commands.ask(Command.ARM)
        self.loop = LoopProcess(
            self.configuration, self.memory, self.commands, order, -3, clock=SYSTEM
        )
        self._number += 1

    def until(self, what: Callable[[], bool]) -> None:
        def holds() -> bool:
            self.recorder.step()
            return what()

        wait_for(holds, f"state {self.memory.state}")

    def during(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end)

    def state(self, state: State) -> None:
        self.until(lambda: self.memory.state == state)

    def end(self) -> dict[str, NDArray[np.float64]]:
        self.until(lambda: self.loop.exit_code is not None)
        self.recorder.close()
        self.loop.close()
        return read_columns(self.stem)


def replay(cell: Path, recording: Path, speed: float = 3.0, **changes: Any) -> dict[str, Any]:
    """Run the loop of a cell on a recording; returns what was recorded of it."""
    given = yaml.safe_load(cell.read_text())
    given["link"] = {"driver": "replay", "file": str(recording), "speed": speed}
    given.update(changes)
    other = cell.parent / "replay.yaml"
    other.write_text(yaml.safe_dump(given))
    loops = Loops(other, "run-replayed")
    return loops.end()


def assert_same_bits(found: dict[str, Any], expected: dict[str, Any], rows: int) -> None:
    for name in COMPARED:
        assert found[name].shape == expected[name].shape, name
        same = np.ascontiguousarray(found[name]).tobytes() == expected[name].tobytes()
        if not same:
            wrong = found[name].reshape(rows, -1) != expected[name].reshape(rows, -1)
            wrong &= ~np.isnan(found[name].reshape(rows, -1))
            first = np.flatnonzero(wrong.any(axis=1))
            assert not len(first), (name, len(first), first[:5], expected["state"][first[:5]])


@pytest.mark.slow
def test_a_run_with_writing_and_two_loops_is_replayed_bit_for_bit(robot: Robot) -> None:
    cell = robot.cell(limits="{offset: 0.0004, ramp_time: 0.7}")  # the envelope is touched
    loops = Loops(cell, "run-then", arm=True)
    loops.state(State.COMPENSATING)
    robot.bench("wrench 0 0 -60 0 0 0")
    loops.during(1.0)
    loops.commands.ask(Command.DISARM)
    loops.state(State.OBSERVING)
    loops.during(0.2)
    loops.commands.ask(Command.ARM)
    loops.state(State.COMPENSATING)
    loops.during(0.8)
    loops.loop.kill()  # amidst the writing
    loops.recorder.step()
    loops.loop.close()
    time.sleep(0.5)
    loops.start(arm=True)
    loops.until(lambda: loops.memory.has_state and loops.memory.state == State.COMPENSATING)
    loops.during(0.4)
    loops.loop.ask_to_stop()
    then = loops.end()
    count = len(then["number"])
    assert set(then["loop"]) == {0.0, 1.0}
    assert then["written"].sum() > 500
    assert {1.0, 2.0, 3.0, 4.0} <= set(then["state"])
    assert then["clamped"].any()
    assert len(set(then["ramp_time"])) > 1  # the stop had a shorter ramp

    again = replay(cell, loops.stem)
    assert len(again["number"]) == count
    assert_same_bits(again, then, count)


@pytest.mark.slow
def test_another_model_makes_other_offsets_of_the_same_states(robot: Robot) -> None:
    loops = Loops(robot.cell(), "run-then")
    loops.until(lambda: loops.memory.written > 300)
    loops.loop.ask_to_stop()
    then = loops.end()
    again = replay(robot.cell(), loops.stem, compliance={"axial": [0.0] * 6, "radial": [0.0] * 6})
    assert again["actual_q"].tobytes() == then["actual_q"].tobytes()
    assert np.linalg.norm(then["offset"][:, :3], axis=1).min() > 1e-4
    assert not again["offset"].any()
