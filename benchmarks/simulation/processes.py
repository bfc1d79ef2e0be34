"""The daemon and its loop as processes of the world; what they do is the product's."""

from __future__ import annotations

import os
import random
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

from benchmarks.simulation.disk import Disk
from benchmarks.simulation.links import SimulatedLink
from benchmarks.simulation.planner import PlannedSource, Planner
from benchmarks.simulation.recording import Recording
from benchmarks.simulation.world import Process, SimulatedClock
from gapbridge.bridge.cell.run_settings import Configuration
from gapbridge.bridge.cell.sections import LimitSettings
from gapbridge.bridge.daemon import reload
from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.daemon.owner_lock import OwnerLock
from gapbridge.bridge.daemon.processes import LoopProcess
from gapbridge.bridge.daemon.reload import Reload
from gapbridge.bridge.daemon.summary import RunSummary
from gapbridge.bridge.daemon.verification_watch import VerificationWatch
from gapbridge.bridge.ipc.command_memory import CommandMemory, Commands
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import Phase, RunMemory, SharedMemory
from gapbridge.bridge.loop.loop import Exit, Loop
from gapbridge.bridge.loop.offset_in_force import OffsetInForce
from gapbridge.bridge.loop.setpoint_stream import SetpointStream, gate_bounds
from gapbridge.bridge.setpoint_source.source import Source, SourceContext
from gapbridge.bridge.setpoint_source.target import TargetSource
from gapbridge.core.errors import GapbridgeError, InputError
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.driver import Driver

STARTING = (0.02, 0.15)  # s that a process takes until it runs
KILLED = -9
COMPUTING = 1e-4  # s: of a cycle
LOOK = 0.02  # s
RETRY = 0.3  # s until a daemon that could not start is started again


@dataclass(frozen=True)
class Chance:
    """What the seed says of a run besides its faults."""

    draw: random.Random
    later: random.Random | None  # draws what was added later; None: nothing of it
    planned_joint: int | None  # from 0, that a planner moves; None: no planner
    is_recorded: bool = False


class Run:
    """One daemon after the other on one link: what all its processes share."""

    def __init__(self, clock: SimulatedClock, link: SimulatedLink, chance: Chance) -> None:
        self.world, self.clock, self.link = clock.world, clock, link
        self.later, self.cell_file = chance.later, "same"
        joint = chance.planned_joint
        self.planner = Planner(self.world, link, joint) if joint is not None else None
        self.offset_in_force = OffsetInForce(link.controller.n, None)  # outlives every process
        self.disk = Disk(self.world.random) if chance.is_recorded else None
        self.recordings: list[Recording] = []
        self.owner_note = ""  # of the daemon's lock; the same
        self.is_marked = False  # in the state folder, which outlives a power cut: a daemon runs
        self.daemons: list[SimulatedDaemon] = []
        self.loops: list[SimulatedLoop] = []
        self.left = 0  # setpoints that have left whole
        self.on_send: Callable[[Setpoint], None] = lambda _: None
        self.on_stop: Callable[[], None] = lambda: None
        self.on_death: Callable[[], None] = lambda: None
        self.on_start: Callable[[], None] = lambda: None
        self.not_started: list[Process] = []  # daemons that did not reach the robot
        self.starts_anew = False  # a daemon that has ended is followed by another
        self.state_behind: RobotState  # the last setpoint
        link.supervisor_state = self.state

    def start(self, arms: bool = False) -> None:
        """Start a daemon; ``arms``: its cell file says that it arms by itself."""
        self.starts_anew = False
        self.daemon = daemon = SimulatedDaemon(self.link.setting.configuration, self)
        self.daemons.append(daemon)
        self.on_start()

        def run() -> RunSummary:
            try:
                return daemon.run(arms, by="the cell file")
            except GapbridgeError:
                if len(self.daemons) > 1:  # the robot cannot be reached just now
                    self.not_started.append(self.process)
                    self.start_anew(RETRY, arms)
                raise
            finally:
                self.on_death()

        self.process = Process(self.world, f"daemon {len(self.daemons)}", run)
        self._record(daemon, self.process)

    def _record(self, daemon: SimulatedDaemon, process: Process) -> None:
        if self.disk is None:
            return
        session = f"run-{len(self.daemons)}"
        recording = Recording(self.disk, self.clock, daemon.memory, session)
        daemon_number, first = len(self.daemons), len(self.loops)

        def is_alone() -> bool:
            return process.over or process.dead

        def is_over() -> bool:
            if not is_alone():
                return False
            if len(self.daemons) > daemon_number:  # which starts once nothing of this one runs
                return True
            return all(loop.process.over or loop.process.dead for loop in self.loops[first:])

        recording.is_alone, recording.is_over = is_alone, is_over
        self.recordings.append(recording)

    def cut_power(self) -> None:
        """End all processes at once, with all that is in memory and not on the disk."""
        self.process.kill()
        if self.loops:
            self.loops[-1].kill()
        if self.disk is not None:
            self.recordings[-1].end()
            self.disk.cut_power()
        self.owner_note = ""
        self.on_death()

    @property
    def compensates(self) -> bool:
        """Return whether a daemon runs that says so."""
        ended = self.process.over or self.process.dead
        return not ended and self.daemon.state == State.COMPENSATING

    @property
    def is_over(self) -> bool:
        """Return whether no daemon runs, and none will."""
        return not self.starts_anew and (self.process.over or self.process.dead)

    def stop(self) -> None:
        """Ask the daemon to end."""
        self.on_stop()
        self.daemon.stop()

    def start_anew(self, seconds: float, arms: bool) -> None:
        """Start another daemon in so many seconds, at the earliest once all of this one is gone.

        That is what a service manager does.
        """
        self.starts_anew = True

        def begin() -> None:
            if not self.starts_anew:
                return
            ended = [self.process, *(loop.process for loop in self.loops[-1:])]
            ended += [recording.process for recording in self.recordings[-1:]]
            if all(process.over or process.dead for process in ended):
                self.start(arms)
            else:
                self.world.after(LOOK, begin)

        self.world.after(seconds, begin)

    def kill_daemon(self) -> None:
        """End the daemon at once: its loop is informed by the system."""
        self.process.kill()
        if self.loops:
            self.loops[-1].end_with_parent()
        self.on_death()

    def state(self) -> int:
        """Return the supervisor's state, as the loop itself knows it."""
        if not self.loops or self.loops[-1].loop is None:
            return 0
        return int(self.loops[-1].loop._supervisor.state)


class SimulatedDaemon(Daemon):
    """The product's daemon without sockets and side processes."""

    longest_wait: float | None = None  # s of real time for the file system of the cell

    def __init__(self, configuration: Configuration, run: Run) -> None:
        self._run = run
        super().__init__(configuration, may_write=True, clock=run.clock)
        self.loop_process = lambda *given: SimulatedLoop(run, *given)  # type: ignore[assignment]
        self._reload = Reload(self.manager, self.event_log, in_thread=False)
        self._zeros.verification = VerificationWatch(self.settings.cell, self.longest_wait)

    def _open(self, stack: ExitStack, arm: bool, by: str) -> bool:
        return self._take_over(stack.enter_context(_Lock(self._run)), arm, by)


class _Lock(OwnerLock):
    """The product's, whose file is the run's."""

    def __init__(self, run: Run) -> None:
        super().__init__("", run.link.setting.cell.path)
        self._run = run

    def acquire(self) -> None:
        """See OwnerLock.acquire; a daemon that is gone holds nothing."""
        self._take_over(self._run.owner_note.encode())

    def _write(self, text: str) -> None:
        self._run.owner_note = text

    def _mark(self) -> bool:
        marked, self._run.is_marked = self._run.is_marked, True
        return marked

    def _remove_mark(self) -> None:
        self._run.is_marked = False


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
            driver = _watched(run, run.link.driver(), self._settings.limits)
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

    def end_with_parent(self) -> None:
        """Ramp out and end: the daemon is gone (see bridge/loop/main.py)."""
        if self.loop is None:
            self.kill()
        else:
            self.loop.request_stop()

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


def _watched(run: Run, driver: Driver, limits: LimitSettings) -> Driver:
    """Return a driver whose setpoints are noted as they are handed to it."""
    driver.gate.set_bounds(gate_bounds(limits))
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

    def counted(setpoint: Setpoint, expiry: float) -> None:
        run.link.sends = not run.link.looks_again
        try:
            write(setpoint, expiry)
        finally:
            run.link.sends = False
        run.left += 1

    driver.read_state = timed  # type: ignore[method-assign]
    driver._send = noted  # type: ignore[method-assign]
    driver.write_setpoint = counted  # type: ignore[method-assign]
    return driver


def _source(run: Run) -> Source:
    setting, link = run.link.setting, run.link
    settings = setting.configuration.settings.setpoints
    moves_arm = setting.wired.moves_arm
    kind: Any = TargetSource if run.planner is None else PlannedSource
    source: Source = kind(
        SourceContext(
            settings, link.controller.n, moves_arm, setting.cell.path.parent,
            setting.wired.rate, run.clock,
        )
    )  # fmt: skip
    if isinstance(source, PlannedSource):
        assert run.planner is not None
        source.attach(run.planner, run.clock)
    return source


@contextmanager
def cell_files(run: Run) -> Iterator[None]:
    """Have the daemon find the run's cell file when it reads it again."""
    before = reload.read_configuration, reload.cell_errors
    reload.read_configuration = lambda _: run.link.setting.read_again(run.cell_file)
    reload.cell_errors = lambda _: []
    try:
        yield
    finally:
        reload.read_configuration, reload.cell_errors = before
