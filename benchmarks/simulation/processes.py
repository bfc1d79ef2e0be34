"""The daemon and its loop as processes of the world; what they do is the product's."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.simulation.links import SimulatedLink
from benchmarks.simulation.world import Process, SimulatedClock, World
from gapbridge.bridge.cell.run_settings import Configuration
from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.daemon.processes import LoopProcess
from gapbridge.bridge.ipc.command_memory import CommandMemory, Commands
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import Phase, RunMemory, SharedMemory
from gapbridge.bridge.loop.loop import Exit, Loop
from gapbridge.bridge.loop.offset_in_force import OffsetInForce
from gapbridge.bridge.loop.setpoint_stream import SetpointStream
from gapbridge.bridge.setpoint_source.interpolator import SetpointInterpolator
from gapbridge.bridge.setpoint_source.source import Source
from gapbridge.bridge.setpoint_source.target import TargetSource
from gapbridge.core.errors import GapbridgeError, InputError
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.driver import Driver

Vector = NDArray[np.float64]
STARTING = (0.02, 0.15)  # s that a process takes until it runs
KILLED = -9
COMPUTING = 1e-4  # s: of a cycle
PLANNED, PLANNED_JOINT = 0.02, 0  # s between two setpoints of the planner; what it moves


class Run:
    """One daemon on one link: what all its processes share."""

    def __init__(
        self, world: World, clock: SimulatedClock, link: SimulatedLink, planned: bool
    ) -> None:
        self.world, self.clock, self.link = world, clock, link
        self.planner = Planner(world, link) if planned else None
        self.offset_in_force = OffsetInForce(link.controller.n, None)  # outlives every process
        self.loops: list[SimulatedLoop] = []
        self.events: list[dict[str, Any]] = []
        self.left = 0  # setpoints that have left whole
        self.on_send: Callable[[Setpoint], None] = lambda _: None
        self.state_behind: RobotState  # the last setpoint
        configuration = link.setting.configuration
        self.daemon = SimulatedDaemon(configuration, self)
        link.supervisor_state = self.state
        self.process = Process(world, "daemon", lambda: self.daemon.run())

    def state(self) -> int:
        """Return the supervisor's state, as the loop itself knows it."""
        if not self.loops or self.loops[-1].loop is None:
            return 0
        return int(self.loops[-1].loop._supervisor.state)


class SimulatedDaemon(Daemon):
    """The product's daemon without locks, sockets and side processes."""

    def __init__(self, configuration: Configuration, run: Run) -> None:
        self._run = run
        super().__init__(configuration, may_write=True, log=self._note, clock=run.clock)
        self.loop_process = lambda *given: SimulatedLoop(run, *given)  # type: ignore[assignment]

    def _note(self, event: dict[str, Any]) -> None:
        self._run.events.append({**event, "seen": self._run.world.now})

    def _open(self, stack: ExitStack, arm: bool, by: str) -> bool:
        return arm


class SimulatedLoop(LoopProcess):
    """One process of the loop: the product's loop, driver and source, in the world's time."""

    def __init__(
        self, run: Run, configuration: Configuration, memory: RunMemory, commands: CommandMemory,
        order: dict[str, Any], *_: Any,
    ) -> None:  # fmt: skip
        memory.renew()
        self._now = run.clock.monotonic
        self._run, self.memory, self._commands = run, memory, commands
        self._settings = configuration.settings
        self._order, self._reported = order, list[dict[str, Any]]()
        self.started = run.world.now
        self.loop: Loop | None = None
        self.killed = False
        self._fds = os.dup(memory.fd), os.dup(commands.fd)
        run.loops.append(self)
        self.process = Process(run.world, f"loop {len(run.loops)}", self._main)

    def _main(self) -> int:
        run, order = self._run, self._order
        run.clock.sleep(run.world.random.uniform(*STARTING))
        try:
            memory = SharedMemory(self.memory.n, self._fds[0], clock=run.clock)
            memory.enter(Phase.STARTING)
            driver = _watched(run, run.link.driver())
            source = _source(run)
            loop = self.loop = _Loop(
                self._settings, run.link.setting.cell.model, driver, source, memory, self._emit,
                order["number"],
            )  # fmt: skip
            loop._in_force = loop._writing._in_force = run.offset_in_force
            _note_states(run, loop._stream)
            commands = Commands(self._fds[1], order["after"])
            code = loop.run(commands, order["may_write"], order["latched"])
        except InputError as error:
            self._emit({"kind": "failure", "detail": str(error)})
            return Exit.INPUT
        except GapbridgeError as error:
            self._emit({"kind": "failure", "detail": str(error)})
            return Exit.LINK
        return code

    def _emit(self, event: dict[str, Any]) -> None:
        clock = self._run.clock
        self._reported.append({"time": clock.time(), "monotonic": clock.monotonic(), **event})

    @property
    def pid(self) -> int:
        """See LoopProcess."""
        return 1000 + len(self._run.loops)

    @property
    def exit_code(self) -> int | None:
        """See LoopProcess."""
        if self.process.dead:
            return KILLED
        if not self.process.over:
            return None
        return Exit.CRASH if self.process.raised is not None else int(self.process.result)

    def events(self) -> list[dict[str, Any]]:
        """See LoopProcess."""
        found, self._reported = self._reported, []
        return found

    def kill(self) -> None:
        """See LoopProcess."""
        if not self.process.over:
            self.process.kill()

    def close(self) -> None:
        """See LoopProcess."""
        self.kill()

    def let_go(self) -> None:
        """Close what the process held open, as the system does behind a real one."""
        for fd in self._fds:
            os.close(fd)


class _Loop(Loop):
    """The product's loop, whose offset in force is the run's."""

    def _open_offset_in_force(self) -> OffsetInForce:
        return OffsetInForce(self._driver.n, None)


def _note_states(run: Run, stream: SetpointStream) -> None:
    """Have the run know the state behind each setpoint."""
    advance = stream.advance

    def noted(state: RobotState, *given: Any) -> Setpoint:
        run.state_behind = state
        return advance(state, *given)

    stream.advance = noted  # type: ignore[method-assign]


def _watched(run: Run, driver: Driver) -> Driver:
    """Return a driver whose setpoints are noted as they are handed to it."""
    from gapbridge.bridge.loop.setpoint_stream import gate_bounds

    driver.gate.set_bounds(gate_bounds(run.link.setting.configuration.settings.limits))
    send = driver._send

    def noted(setpoint: Setpoint) -> None:
        run.on_send(setpoint)
        send(setpoint)

    write, read = driver.write_setpoint, driver.read_state

    def timed() -> RobotState:
        try:
            return read()
        except GapbridgeError:
            run.clock.sleep(COMPUTING)  # else a loop without a link would stop the time
            raise

    def counted(setpoint: Setpoint) -> None:
        write(setpoint)
        run.left += 1

    driver.read_state = timed  # type: ignore[method-assign]
    driver._send = noted  # type: ignore[method-assign]
    driver.write_setpoint = counted  # type: ignore[method-assign]
    return driver


def _source(run: Run) -> Source:
    setting, link = run.link.setting, run.link
    settings = setting.configuration.settings.setpoints
    moves_arm = setting.wired.moves_arm
    kind: Any = TargetSource if run.planner is None or not moves_arm else PlannedSource
    source: Source = kind(
        settings, link.controller.n, moves_arm, setting.cell.path.parent, setting.wired.rate
    )
    if isinstance(source, PlannedSource):
        assert run.planner is not None
        source.attach(run.planner, run.clock)
    return source


class Planner:
    """Sends setpoints: a slow circle of one joint about where the arm stands, or nonsense."""

    def __init__(self, world: World, link: SimulatedLink) -> None:
        self._world, self._link = world, link
        self.take: Callable[[Vector], None] = lambda _: None
        self.silent_until = 0.0
        self.nonsense: Callable[[Vector], Vector] | None = None
        self._at: Vector | None = None
        self._time = 0.0
        world.every(lambda: PLANNED, self._send)

    def _send(self) -> None:
        if self._at is None or self._link.supervisor_state() != State.COMPENSATING:
            self._at, self._time = np.array(self._link.controller.q), 0.0  # begins there
        if self._world.now < self.silent_until:
            return
        self._time += PLANNED
        q = self._at.copy()
        q[PLANNED_JOINT] += 0.02 * np.sin(0.5 * self._time) ** 2
        if self.nonsense is not None:
            q = self.nonsense(q)
        self.take(q)


class PlannedSource(Source):
    """What a planner sends, by the product's own interpolator; its socket is not simulated."""

    def attach(self, planner: Planner, clock: SimulatedClock) -> None:
        """Take what the planner sends from now on."""
        self._interpolator = SetpointInterpolator(self.settings.timeout, "line", clock)
        planner.take = self._take

    def _take(self, q: Vector) -> None:
        if not np.isfinite(q).all():
            return  # a line that is no setpoint never comes so far
        self._interpolator.take(q)
        self._interpolator.restart()

    def discard(self) -> None:
        """See Source.discard."""
        self._interpolator.forget()

    def first(self, robot_q: Vector) -> Vector | None:
        """See Source.first."""
        return self._interpolator.first()

    def begin(self, timestamp: float, robot_q: Vector) -> None:
        """See Source.begin."""
        self._interpolator.begin(robot_q)

    def sample(self, timestamp: float, robot_q: Vector) -> Vector:
        """See Source.sample."""
        return self._interpolator.sample()
