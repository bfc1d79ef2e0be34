"""Play of the joints in the loop: the direction of approach is that of what is commanded."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clock_by_hand import ByHand

from gapbridge.bridge.cell.run_settings import read_configuration
from gapbridge.bridge.ipc.command_memory import Command
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.loop.loop import Loop
from gapbridge.bridge.setpoint_source.source import Source, SourceContext
from gapbridge.bridge.setpoint_source.target import TargetSource
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.offset_inverse import Nominal

Q = np.array([0.0, -1.5, 1.8, -1.87, -1.57, 0.0])
RATE, COUNT = 500.0, 12e-6  # Hz; rad of a UR's encoder
PLAY = 5e-4  # rad
ARM_AT, OUT, STAND, BACK, LAST = 10, 600, 1000, 1600, 2000  # cycles
SPEED = 0.05  # rad/s
CELL = f"""robot: {{model: ur10e}}
effects: [{{effect: backlash, joint: 2, parameters: {{value: {PLAY}}}}}]
payload: {{mass: 5.0, cog: [0, 0, 0.06]}}
link: {{driver: ur_rtde, host: 127.0.0.1}}
"""


def way(cycle: int) -> np.ndarray:
    """Return the joints of a program that moves joint 2 out, stands, moves it back and stands."""
    moved = min(max(cycle - OUT, 0), 200) - min(max(cycle - BACK, 0), 100)
    return Q + np.array([0, moved * SPEED / RATE, 0, 0, 0, 0])


class NoisyArm(Driver):
    """An arm that follows at once and reads its joints with an encoder's noise.

    It is moved by setpoints, or by its own program, to which it adds the offset.
    """

    def __init__(self, model: Any, moves_arm: bool) -> None:
        super().__init__(RATE, model, moves_arm, clock=ByHand())
        self.cycle, self.sent = 0, {0: Q}
        self._noise, self._nominal = np.random.default_rng(0), Nominal(model)
        self._target, self._offset = Q, np.zeros(6)

    def connect(self) -> None: ...

    def _read_state(self) -> RobotState:
        self.cycle += 1
        self.clock.sleep(1.0 / RATE)
        if not self.moves_arm:
            self._target = self._nominal.without(way(self.cycle), -self._offset)
        now, still = self.clock.monotonic(), np.zeros(6)
        read = COUNT * np.round((self._target + self._noise.normal(0.0, 2e-5, 6)) / COUNT)
        return RobotState(now, now, read, still, self._target, still)

    def nominal_q(self, state: RobotState) -> np.ndarray:
        if self.moves_arm:
            return state.target_q
        return self._nominal.without(state.target_q, self._offset)

    def _send(self, setpoint: Setpoint) -> None:
        self.sent[self.cycle] = setpoint.q.copy()
        self._offset = setpoint.offset_in_base.copy()
        if self.moves_arm:
            self._target = setpoint.q.copy()

    def close(self) -> None: ...


class Program(Source):
    """A source that follows the same way."""

    driver: NoisyArm

    def first(self, robot_q: np.ndarray) -> np.ndarray:
        return way(self.driver.cycle)

    def sample(self, timestamp: float, robot_q: np.ndarray) -> np.ndarray:
        return way(self.driver.cycle)


class Asked:
    """Arms once; stops after the last cycle."""

    stop, last_taken, beats = False, 0, 0

    def __init__(self, driver: NoisyArm) -> None:
        self._driver, self._armed = driver, False

    def number_of(self, command: Command) -> int:
        return 0

    def take(self) -> list[Command]:
        self.stop = self._driver.cycle > LAST
        if self._armed or self._driver.cycle < ARM_AT:
            return []
        self._armed = True
        return [Command.ARM]


@pytest.fixture
def memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[SharedMemory]:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    memory = SharedMemory(6, clock=SYSTEM)
    yield memory
    memory.close()


@pytest.mark.parametrize("moves_arm", [True, False])
def test_the_command_of_a_standing_joint_stands_and_a_reversal_takes_the_play_up(
    tmp_path: Path, memory: SharedMemory, moves_arm: bool
) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(CELL)
    configuration = read_configuration(cell)
    settings = configuration.settings
    driver = NoisyArm(configuration.model, moves_arm)
    context = SourceContext(settings.setpoints, 6, moves_arm, tmp_path, RATE, driver.clock)
    source: Source = Program(context) if moves_arm else TargetSource(context)
    source.driver = driver  # type: ignore[attr-defined]
    events: list[dict[str, Any]] = []
    loop = Loop(settings, configuration.model, driver, source, memory, events.append)
    asked: Any = Asked(driver)
    loop.run(asked, may_write=True)
    offset = {k: q[1] - way(k)[1] for k, q in driver.sent.items()}
    stands = [offset[k] for k in (*range(STAND, BACK), *range(BACK + 200, LAST))]
    signs = np.where(np.arange(len(stands)) < BACK - STAND, 1.0, -1.0)
    assert np.array(stands) == pytest.approx(0.5 * PLAY * signs, abs=1e-6)
    assert not any(abs(offset[k]) > 1e-9 for k in range(ARM_AT + 5, OUT))
    step = abs(offset[BACK + 3] - offset[BACK])
    assert step > 0.0  # within two cycles the limiter is on its way to the other side
