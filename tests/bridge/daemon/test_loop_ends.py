"""What the daemon does where a process of its loop ends, hangs or does not stop; no time passes."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable
from contextlib import ExitStack
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from gapbridge.bridge.cell.run_settings import read_configuration
from gapbridge.bridge.daemon.daemon import STOP_MARGIN, TICK, Daemon
from gapbridge.bridge.daemon.owner_lock import OwnerLock
from gapbridge.bridge.daemon.processes import LoopProcess
from gapbridge.bridge.daemon.summary import RunSummary
from gapbridge.bridge.ipc.command_memory import Command, CommandMemory, Commands
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import Phase, RunMemory, SharedMemory
from gapbridge.bridge.loop.loop import STOP_TIMEOUT, Exit
from gapbridge.bridge.loop.setpoint_stream import longest_ramp_out
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.core.errors import LinkError
from gapbridge.drivers.clock import Clock

CELL = """robot: {model: ur10e}
link: {driver: ur_rtde, host: 192.0.2.7}
"""
LONGEST = 60.0  # s after which a test gives up


class ByHand(Clock):
    """A clock that begins at 0 s and goes on where somebody waits; calls ``acts`` at their time."""

    def __init__(self) -> None:
        self.now = 0.0
        self.acts: dict[float, Callable[[], object]] = {}
        self.monotonic = self.time = lambda: 100.0 + self.now
        self.sleep = self._pass

    def _pass(self, seconds: float) -> None:
        before, self.now = self.now, self.now + seconds
        for at, act in self.acts.items():
            if before < at <= self.now:
                act()
        assert self.now < LONGEST, "the daemon does not end"

    def wait(self, event: threading.Event, seconds: float) -> bool:
        self._pass(seconds)
        return event.is_set()


class Played(LoopProcess):
    """A loop that reads states and ends when it is to stop, unless it is ``deaf``.

    ``silent``: its heart stands still. ``dies``: the exit code with which it dies at 0.5 s.
    ``ramps``: s that it takes to stop. ``ends``: s at which its trajectory does; ``tells``:
    its state and the event of how it came there.
    """

    pid = 1

    def __init__(
        self, how: dict[str, Any], configuration: Any, memory: RunMemory, commands: CommandMemory,
        order: dict[str, Any], log: Any, clock: ByHand,
    ) -> None:  # fmt: skip
        memory.renew()
        self.memory, self._commands, self._settings = memory, commands, configuration.settings
        self.how, self.order, self._clock = how, order, clock
        self._now, self.started = clock.monotonic, clock.monotonic()
        self.killed_at: float | None = None
        self.asked_at: float | None = None  # to stop
        self._stops = commands.last_of(Command.STOP)  # of the loops before it
        self.own = SharedMemory(memory.n, memory.fd, clock=clock)
        self.own.enter(Phase.RUNNING)
        self.own.note_state_read()
        self._news = [how["tells"]] if "tells" in how else []
        self.own.note_state(State[how["tells"]["to"]] if "tells" in how else State.OBSERVING)

    @property
    def exit_code(self) -> int | None:
        if "silent" not in self.how:
            self.own.beat()
        if self.killed_at is not None:
            return -9
        if "ends" in self.how and self._clock.now > self.how["ends"]:
            self.own.note_ended()
        if "dies" in self.how and self._clock.now > 0.5:
            return int(self.how["dies"])
        if self.asked_at is None and self._commands.last_of(Command.STOP) > self._stops:
            self.asked_at = self._clock.now
        if self.asked_at is None or "deaf" in self.how:
            return None
        return Exit.DONE if self._clock.now >= self.asked_at + self.how.get("ramps", 0.0) else None

    def events(self) -> list[dict[str, Any]]:
        news, self._news = self._news, []
        return news

    def kill(self) -> None:
        self.killed_at = self._clock.now

    def close(self) -> None:
        if self.exit_code is None:
            self.kill()


class Bench(Daemon):
    """A daemon without sockets and side processes; each loop of it does as it is told."""

    locked = False  # it owns its controller

    def __init__(self, folder: Path, *how: dict[str, Any], may_write: bool = True) -> None:
        cell = folder / "cell.yaml"
        cell.write_text(CELL)
        self.clock, self.loops = ByHand(), list[Played]()
        super().__init__(read_configuration(cell), may_write, clock=self.clock)
        todo = iter(how)

        def make(*given: Any) -> Played:
            told = next(todo, {})
            if "refused" in told:
                raise OSError(errno.EAGAIN, "no process is left")
            self.loops.append(Played(told, *given))
            return self.loops[-1]

        self.loop_process = make  # type: ignore[assignment]

    def _open(self, stack: ExitStack, arm: bool, by: str) -> bool:
        if not self.locked:
            return arm
        cell = self.settings.cell  # its address is no other test's, in another checkout either
        return self._take_over(stack.enter_context(OwnerLock(f"host {cell}", cell)), arm, by)

    def run_until(self, seconds: float, arm: bool = False) -> RunSummary:
        """Run, and ask to stop after so many seconds."""
        self.clock.acts[seconds] = self.stop
        try:
            return self.run(arm=arm, by="--arm")
        finally:
            self.asked = {command: self._commands.last_of(command) for command in Command}
            self._commands.close()
            self.memory.close()


def test_a_loop_that_does_not_stop_is_killed_at_the_deadline(tmp_path: Path) -> None:
    daemon = Bench(tmp_path, {"deaf": True})
    summary = daemon.run_until(1.0)
    own = STOP_TIMEOUT + longest_ramp_out(daemon.settings.limits)  # the loop's deadline
    assert own + STOP_MARGIN < daemon.clock.now - 1.0 < own + STOP_MARGIN + 5 * TICK
    assert daemon.asked[Command.STOP]
    assert summary.exit_code == 1
    assert summary.faults == (f"the loop has not stopped within {own + STOP_MARGIN:.1f} s: killed",)


def test_a_loop_that_stops_is_not_killed(tmp_path: Path) -> None:
    daemon = Bench(tmp_path)
    summary = daemon.run_until(1.0)
    assert daemon.loops[0].killed_at is None
    assert daemon.clock.now < 1.0 + 3 * TICK
    assert not summary.faults


def test_a_loop_without_a_heartbeat_is_killed_and_another_one_observes(tmp_path: Path) -> None:
    daemon = Bench(tmp_path, {"silent": True})
    summary = daemon.run_until(5.0, arm=True)
    first, second = daemon.loops
    assert first.killed_at == pytest.approx(daemon.settings.hang_timeout, abs=3 * TICK)
    assert summary.restarts == 1
    assert summary.faults[0].startswith("no heartbeat of the loop for")
    assert second.order["after"] >= daemon.asked[Command.ARM]


def test_a_loop_that_takes_the_place_of_a_dead_one_is_not_armed(tmp_path: Path) -> None:
    daemon = Bench(tmp_path, {"dies": Exit.CRASH})
    daemon.run_until(5.0, arm=True)
    first, second = daemon.loops
    assert first.order["after"] < daemon.asked[Command.ARM]
    assert second.order["after"] >= daemon.asked[Command.ARM]


def test_a_daemon_that_only_observes_never_asks_to_arm(tmp_path: Path) -> None:
    daemon = Bench(tmp_path, may_write=False)
    daemon.run_until(1.0, arm=True)
    assert daemon.asked[Command.ARM] == 0
    assert not daemon.loops[0].order["may_write"]


@pytest.mark.parametrize("at", [0.2, 0.6])  # of the first loop, which takes nothing; between both
def test_a_disarming_that_no_loop_has_taken_is_for_the_next(tmp_path: Path, at: float) -> None:
    daemon = Bench(tmp_path, {"dies": Exit.CRASH})
    daemon.clock.acts[at] = daemon.disarm
    daemon.run_until(5.0)
    asked = max(daemon.asked[Command.DISARM], daemon.asked[Command.RAMP_OUT])
    assert daemon.loops[1].order["after"] < asked


def test_side_processes_are_told_of_a_cell_once_it_is_in_use(tmp_path: Path) -> None:
    daemon, told = Bench(tmp_path, {"ramps": 0.5}), list[tuple[str, str]]()
    daemon._reload._in_thread = False
    daemon.side_processes.emit = lambda event: told.append(  # type: ignore[method-assign]
        (str(event["kind"]), daemon.configuration.text)
    )
    daemon.event_log._listeners = (daemon._on_event, daemon.side_processes.emit)
    changes = {0.2: f"{CELL}limits: {{offset: -1}}\n", 1.0: f"{CELL}limits: {{offset: 0.002}}\n"}

    def change(text: str) -> None:
        daemon.settings.cell.write_text(text)
        daemon.reload()

    for at, text in changes.items():
        daemon.clock.acts[at] = lambda text=text: change(text)  # type: ignore[misc]
    daemon.run_until(3.0)
    found = [(kind, text) for kind, text in told if kind in ("configuration", "cell")]
    assert found == [("configuration", CELL), ("configuration", CELL), ("cell", changes[1.0])]


def test_loops_that_die_are_started_again_more_and_more_slowly(tmp_path: Path) -> None:
    daemon = Bench(tmp_path, *[{"dies": Exit.CRASH}] * 6)
    daemon.run_until(5.0)
    begun = [loop.started for loop in daemon.loops][1:]  # behind the first pause
    first, most = daemon.settings.backoff
    waits = [b - a for a, b in pairwise(begun)]
    expected = [min(2.0**k * first, most) for k in range(1, len(begun))]
    assert waits == pytest.approx(expected, abs=4 * TICK)
    assert len(waits) > 2


def test_a_loop_that_cannot_be_started_counts_as_one_that_ended(tmp_path: Path) -> None:
    daemon = Bench(tmp_path, {"dies": Exit.CRASH}, {"refused": True}, {"refused": True})
    summary = daemon.run_until(5.0, arm=True)
    detail = "the loop's process cannot be started: no process is left"
    assert summary.faults[1:] == (detail, detail)
    assert summary.restarts == 3
    first, second = daemon.loops
    assert second.order["after"] >= daemon.asked[Command.ARM] > first.order["after"]
    assert second.started - first.started > 0.5 + 7 * daemon.settings.backoff[0]  # 1 + 2 + 4


def test_a_first_loop_that_cannot_be_started_ends_the_run(tmp_path: Path) -> None:
    with pytest.raises(LinkError, match="cannot be started"):
        Bench(tmp_path, {"refused": True}).run_until(5.0)


def fault(to: State, cause: Cause) -> dict[str, Any]:
    return {
        "kind": "transition", "from": "HOLDING", "to": to.name, "cause": cause, "detail": "",
        "time": 100.0, "monotonic": 100.0,
    }  # fmt: skip


class Owner(Bench):
    """One that owns its controller, and whose cell file says that it arms."""

    locked = True

    def run_as_a_service(self, seconds: float) -> RunSummary:
        """Run; returns how it went."""
        self.clock.acts[seconds] = self.stop
        try:
            return self.run(arm=True, by="the cell file")
        finally:
            self.armed = bool(self._commands.last_of(Command.ARM))
            self._commands.close()
            self.memory.close()


@pytest.mark.parametrize(
    ("how", "arms", "latched"),
    [
        ({}, True, ""),
        ({"tells": fault(State.FAULT, Cause.UNSAFE)}, False, Cause.UNSAFE),
        ({"tells": fault(State.FAULT, Cause.SILENCE)}, False, ""),  # ends with that link
        ({"ends": 0.4, "ramps": 1.0, "dies": Exit.LINK}, False, ""),  # in the last ramp
    ],
)
def test_what_has_not_ended_in_order_does_not_begin_again_by_itself(
    runtime: Path, tmp_path: Path, how: dict[str, Any], arms: bool, latched: str
) -> None:
    first, second = Owner(tmp_path, how), Owner(tmp_path)
    first.run_as_a_service(2.0)
    assert first.armed
    second.run_as_a_service(2.0)
    assert second.armed == arms
    assert second.loops[0].order["latched"] == latched
    third = Owner(tmp_path)
    third.run_as_a_service(2.0)  # the second ended in order, unless it has the fault
    assert third.armed == (not latched)


class Obeying(Played):
    """A loop that compensates when it is to arm, and observes when it is to ramp out; at once."""

    def __init__(self, how: dict[str, Any], *given: Any) -> None:
        super().__init__(how, *given)
        _, _, commands, order, *_ = given
        self.state, self._received = State.OBSERVING, Commands(commands.fd, order["after"])

    def events(self) -> list[dict[str, Any]]:
        for command in self._received.take():
            if command == Command.STOP:
                continue
            to = State.COMPENSATING if command == Command.ARM else State.OBSERVING
            if to != self.state:
                cause = Cause.ARM if to == State.COMPENSATING else Cause.DISARM
                self._news.append(fault(to, cause) | {"from": self.state.name})
            self.state = to
        self.own.note_taken(self._received.last_taken)
        self.own.note_state(self.state)
        return super().events()


@pytest.mark.parametrize(
    ("of", "name", "loop"),  # a method of the daemon; of the how manieth loop
    [("", "", 0), ("_reload", "swap", 1), ("", "_take_configuration", 1),
     ("_requests", "repeat", 1), ("_requests", "repeat", 0)],
)  # fmt: skip
def test_who_disarms_before_a_loop_arms_by_itself_is_obeyed(
    tmp_path: Path, of: str, name: str, loop: int
) -> None:
    daemon = Bench(tmp_path)
    daemon.settings.cell.write_text(CELL + "setpoints: {arm: true}\n")
    daemon._reload._in_thread = False
    daemon.clock.acts[1.0] = daemon.reload

    def make(*given: Any) -> Obeying:
        daemon.loops.append(Obeying({}, *given))
        return daemon.loops[-1]

    daemon.loop_process = make  # type: ignore[assignment]
    owner = getattr(daemon, of) if of else daemon
    goes_on = getattr(owner, name) if name else None

    def disarmed_first(*given: Any) -> Any:
        if len(daemon.loops) == loop:
            daemon.disarm("a person")
        return goes_on(*given)

    if name:
        setattr(owner, name, disarmed_first)
    daemon.run_until(3.0, arm=True)
    first, second = daemon.loops
    assert isinstance(first, Obeying)
    assert isinstance(second, Obeying)
    assert second.order["number"] == 1
    assert (second.state == State.COMPENSATING) == (not name)


class Connecting(Played):
    """A loop that is being connected, and has read no state."""

    def __init__(self, how: dict[str, Any], *given: Any) -> None:
        super().__init__(how, *given)
        self.own.enter(Phase.CONNECTING)


def test_a_reload_before_the_robot_is_connected_is_no_fault(tmp_path: Path) -> None:
    daemon = Bench(tmp_path)
    daemon._reload._in_thread = False
    connecting = iter([(Connecting, {"deaf": True})])

    def make(*given: Any) -> Played:
        kind, how = next(connecting, (Played, {}))
        daemon.loops.append(kind(how, *given))
        return daemon.loops[-1]

    daemon.loop_process = make  # type: ignore[assignment]
    daemon.clock.acts[1.0] = daemon.reload
    summary = daemon.run_until(3.0)
    first, second = daemon.loops
    assert first.killed_at is not None
    assert second.started == pytest.approx(first.killed_at + 100.0, abs=3 * TICK)  # no pause
    assert summary.faults == ()
    assert summary.restarts == 0


def fails() -> None:
    raise ZeroDivisionError


@pytest.mark.parametrize("how", [{"ramps": 0.7}, {"deaf": True}])
def test_a_daemon_that_fails_has_its_loop_ramp_out(tmp_path: Path, how: dict[str, Any]) -> None:
    daemon = Bench(tmp_path, how)
    daemon.clock.acts[1.0] = fails
    with pytest.raises(ZeroDivisionError):
        daemon.run_until(30.0)
    (loop,) = daemon.loops
    assert daemon.asked[Command.STOP]
    if "deaf" not in how:
        assert loop.killed_at is None
        return
    assert loop.killed_at is not None
    own = STOP_TIMEOUT + longest_ramp_out(daemon.settings.limits)  # the loop's deadline
    assert own < loop.killed_at - 1.0 < own + STOP_MARGIN + 5 * TICK
