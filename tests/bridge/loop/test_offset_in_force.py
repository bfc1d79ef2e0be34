"""The offset that remains in an arm after a fault: for how long it is believed to be there."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clock_by_hand import ByHand
from test_loop_release import RATE, Bench, Q

from gapbridge.bridge.cell.sections import LimitSettings
from gapbridge.bridge.ipc.command_memory import Command
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.loop.offset_in_force import MOVED_AWAY, InForce, OffsetInForce
from gapbridge.bridge.loop.setpoint_stream import SetpointStream, gate_bounds
from gapbridge.bridge.setpoint_source.source import SourceContext
from gapbridge.bridge.setpoint_source.target import TargetSource
from gapbridge.core.arm import builtin_arm
from gapbridge.core.compensation import correct
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.gate import Gate

DELTA = np.full(6, 1e-3)
STOP, FINE, DISARM, ARM_AGAIN, LAST = 620, 700, 720, 1000, 1800  # cycles


@pytest.fixture
def kept() -> OffsetInForce:
    kept = OffsetInForce(6, None)
    kept.note(Q + DELTA, DELTA, np.zeros(6))
    return kept


def test_an_arm_that_comes_back_has_no_offset_any_more(kept: OffsetInForce) -> None:
    here, away = Q + DELTA + 0.5 * MOVED_AWAY, Q + DELTA + 1.5 * MOVED_AWAY
    kept.follow(here)
    assert kept.offset_at(here) is not None
    kept.follow(away)
    kept.follow(here)
    assert kept.offset_at(here) is None
    kept.take_back()
    assert kept.offset_at(here) is None


def test_an_arm_that_is_still_on_its_way_to_the_last_setpoint_keeps_it(kept: OffsetInForce) -> None:
    for behind in (3.0, 2.0, 1.0, 0.0):
        kept.follow(Q + DELTA - behind * MOVED_AWAY)
    assert kept.offset_at(Q + DELTA) is not None


def test_an_arm_at_the_nominal_joints_was_moved_there_without_the_offset(
    kept: OffsetInForce,
) -> None:
    """Unseen, while no loop ran; an arm that has merely sagged is not exactly there."""
    assert kept.offset_at(Q) is None
    assert kept.offset_at(Q + 0.1 * DELTA) is not None


class Moved(Bench):
    """A loop on an arm that its setpoints move, and that an operator moves while it stands."""

    def __init__(self, folder: Path, memory: SharedMemory) -> None:
        super().__init__(folder, memory)
        self.q, self.sent = Q.copy(), list[np.ndarray]()
        settings = self.loop._settings.setpoints
        source = TargetSource(SourceContext(settings, 6, True, folder, RATE, SYSTEM))
        self.loop._source = self.loop._writing._source = source
        self.driver._read_state = self.read  # type: ignore[method-assign]
        self.driver._send = self.send  # type: ignore[method-assign]

    def read(self) -> RobotState:
        clock, still = self.driver.clock, np.zeros(6)
        clock.sleep(1.0 / RATE)
        now, q = clock.monotonic(), self.q.copy()
        return RobotState(now, now, q, still, q, still, safety_mode=self.driver.safety_mode)

    def send(self, setpoint: Setpoint) -> None:
        self.q = setpoint.q.copy()
        self.sent.append(self.q)

    def move(self, to: np.ndarray) -> Callable[[], None]:
        def moves() -> None:
            self.q = to.copy()

        return moves

    def mode(self, safety_mode: int) -> Callable[[], None]:
        def changes() -> None:
            self.driver.safety_mode = safety_mode

        return changes


@pytest.mark.parametrize("away", [0.3, 0.0])
def test_an_arm_jogged_away_and_back_to_where_it_was_taught_is_corrected_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, away: float
) -> None:
    """After a protective stop; seen by the loop on its way, or (0.0) only when it is back."""
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    memory = SharedMemory(6, clock=SYSTEM)
    bench, turn = Moved(tmp_path, memory), np.eye(6)[0]
    steps = np.linspace(0.0, away, 31)
    script: dict[int, Any] = {
        20: Command.ARM,
        STOP: bench.mode(3),
        FINE: bench.mode(1),
        DISARM: Command.DISARM,
        ARM_AGAIN: Command.ARM,
    }
    script |= {800 + k: bench.move(Q - way * turn) for k, way in enumerate(steps)}
    script |= {900 + k: bench.move(Q - way * turn) for k, way in enumerate(steps[::-1])}
    bench.run(script, LAST)
    memory.close()
    assert bench.causes().count("writing") == 2
    wanted = correct(bench.driver._cell_model, Q[None]).q[0]
    assert np.abs(wanted - Q).max() > 1e-5
    settled = bench.sent[STOP - 40], bench.sent[STOP - 20 + 700]
    assert settled[0] == pytest.approx(wanted, abs=1e-9)
    assert settled[1] == pytest.approx(wanted, abs=1e-9)


@pytest.mark.parametrize("joint", range(4))
@pytest.mark.parametrize("speed", [0.0, 0.1, -0.1])
def test_an_offset_beyond_a_narrowed_envelope_comes_in_while_the_source_moves(
    joint: int, speed: float
) -> None:
    """The gate passes what never grows, also where the nominal joints come towards the command."""
    soft = Model(builtin_arm("ur10e"), payload_mass=8.0)
    soft = soft.with_compliance(np.full(6, 5e-5), np.full(6, 1e-5))
    home = np.array([0.3, -1.5, 1.8, -1.2, -1.57, 0.4])
    found = correct(soft, home[None])
    delta, offset = found.q[0] - home, found.offset_in_base[0]
    assert np.linalg.norm(offset[:3]) > 0.006
    limits, clock = LimitSettings(offset=0.001), ByHand()
    stream = SetpointStream(soft, limits, RATE, clock)
    gate = Gate(RATE, soft, True, clock.monotonic)
    gate.set_bounds(gate_bounds(limits))
    command = home + delta
    stream.start(command, clock.now, in_force=InForce(delta, offset))
    gate.begin(command)
    source, still = command.copy(), np.zeros(6)
    for k in range(400):
        clock.sleep(1.0 / RATE)
        source = source.copy()
        source[joint] += speed * min(k / 50.0, 1.0) / RATE
        state = RobotState(clock.now, clock.now, command, still, command, still)
        setpoint = stream.advance(state, source, Loads(), 1.0)
        gate.check(setpoint)
        gate.sent()
        command = setpoint.q.copy()
    assert np.linalg.norm(setpoint.offset_in_base[:3]) < 0.001 * (1.0 + 1e-9)
