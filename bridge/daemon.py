"""The daemon: the parent that survives its loop.

It starts the loop in a process of its own, watches the heartbeat, ends what hangs, starts anew what
died (observing, never writing), records every cycle, and says at the end how it went.
"""

from __future__ import annotations

import gc
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import click
from pydantic import ValidationError

from bridge.cell import Cell, load_cell
from bridge.daemon_settings import DaemonSettings
from bridge.loop import LONGEST_STOP, Exit
from bridge.loop_process import LoopProcess
from bridge.recorder import Recorder
from bridge.shared_page import Command, Page
from bridge.summary import RunSummary, Tally
from bridge.supervisor import State
from core.errors import CellError, InputError, LinkError

TICK = 0.02  # s between two looks at the loop
HEALTHY = 10.0  # s after which a restart counts as the first again
STOP_MARGIN = 0.4  # s on top of the loop's own time: then it is ended by force

Say = Callable[[str], None]


def settings_of(cell: Cell) -> DaemonSettings:
    """Return what a run of this cell is made of. Raises CellError where sections do not fit."""
    if cell.link is None:
        raise CellError(f"{cell.path}: link: found nothing, expected the robot's address for a run")
    try:
        return DaemonSettings(
            cell=cell.path.resolve(), link=cell.link, limits=cell.limits,
            setpoints=cell.setpoints.model_copy(
                update={"file": cell.setpoints.file and cell.setpoints.file.resolve()}
            ),
            recording=cell.recording, ft_sensor=cell.ft_sensor,
        )  # fmt: skip
    except ValidationError as error:
        words = str(error.errors()[0]["msg"]).removeprefix("Value error, ")
        raise CellError(f"{cell.path}: {words}") from None


def run_cell(
    cell: Cell | Path, observe: bool = False, arm: bool = False, duration: float | None = None
) -> int:
    """Run a cell's daemon until it is stopped, its trajectory ends or ``duration`` s are over.

    Prints what happens and a summary; returns the exit code. Raises InputError for a cell that
    cannot be run, LinkError where the robot cannot be reached.
    """
    settings = settings_of(cell if isinstance(cell, Cell) else load_cell(cell))
    summary = run_daemon(
        settings, observe=observe, arm=arm or settings.setpoints.arm, duration=duration,
        say=click.echo,
    )  # fmt: skip
    for line in summary.lines():
        click.echo(line)
    gc.freeze()  # else Python's last collection, of all compiled code, delays the end by 0.5 s
    return summary.exit_code


def run_daemon(
    settings: DaemonSettings,
    observe: bool = False,
    arm: bool = False,
    duration: float | None = None,
    say: Say = lambda _: None,
) -> RunSummary:
    """Run the daemon and return how it went; see ``run_cell``. Stops on SIGINT and SIGTERM."""
    daemon = Daemon(settings, may_write=not observe, say=say)
    with _signals(daemon.stop):
        return daemon.run(arm=arm and not observe, duration=duration)


class Daemon:
    """One run. ``stop``, ``arm`` and ``disarm`` may be called from other threads."""

    def __init__(
        self, settings: DaemonSettings, may_write: bool, say: Say = lambda _: None
    ) -> None:
        self._settings = settings
        self._n = load_cell(settings.cell).arm.n
        self._page = Page(self._n)  # one for the whole run, whatever becomes of the loops
        self._reader = self._page.reader()
        self._may_write, self._say = may_write, say
        self._recorder = Recorder(settings.recording, self._n)
        self._tally = Tally(self._n, settings.link.rate)
        self._loop: LoopProcess | None = None
        self._failure: dict[str, Any] = {}
        self._faults: list[str] = []
        self._refused = False  # writing was asked for and could not begin
        self._seen = False  # a state has been read, by this or a former loop
        self._restarts = 0
        self._wait = settings.backoff[0]
        self._last_state = State.DISCONNECTED
        self._stopping = threading.Event()

    # -- for others -------------------------------------------------------------------------------

    @property
    def state(self) -> State:
        """Return what the loop is doing."""
        return self._last_state

    @property
    def loop_pid(self) -> int | None:
        """Return the process id of the loop, None between two of them."""
        loop = self._loop
        return None if loop is None else loop.pid

    @property
    def recording(self) -> Path | None:
        """Return the file that cycles go to."""
        return self._recorder.path

    def stop(self) -> None:
        """Ramp out and end."""
        self._stopping.set()

    def arm(self) -> None:
        """Ask the loop to write setpoints."""
        if self._loop is not None and self._may_write:
            self._loop.page.ask(Command.ARM)

    def disarm(self) -> None:
        """Ask the loop to ramp out and observe."""
        if self._loop is not None:
            self._loop.page.ask(Command.DISARM)

    # -- the run ----------------------------------------------------------------------------------

    def run(self, arm: bool = False, duration: float | None = None) -> RunSummary:
        """Run until stopped; see run_cell."""
        try:
            while not self._stopping.is_set():
                self._run_loop(arm, duration)
                arm = False  # whatever happened, only a person starts the writing again
                if self._stopping.is_set():
                    break
                self._stopping.wait(self._wait)
                self._wait = min(2.0 * self._wait, self._settings.backoff[1])
                self._restarts += 1
            return self._summary()
        finally:
            self._recorder.close()
            self._page.close()

    def _run_loop(self, arm: bool, duration: float | None) -> None:
        """Run one process of the loop to its end."""
        output = self._recorder.output
        self._failure = {}
        log: Any = output if output is not None else -3  # subprocess.DEVNULL
        loop = self._loop = LoopProcess(
            self._settings, self._page, arm, self._may_write, log, self._restarts
        )
        stop_by = None
        first_cycle = None
        try:
            while loop.exit_code is None:
                time.sleep(TICK)
                self._take(loop)
                if loop.page.seen and first_cycle is None:
                    first_cycle, self._seen = time.monotonic(), True
                over = first_cycle is not None and (
                    duration is not None and time.monotonic() - first_cycle >= duration
                )
                if over or (loop.page.ended and duration is None):
                    self._stopping.set()
                if self._stopping.is_set() and stop_by is None:
                    stop_by = time.monotonic() + LONGEST_STOP + STOP_MARGIN
                    loop.ask_to_stop()
                if loop.hangs or (stop_by is not None and time.monotonic() > stop_by):
                    self._fault(f"the loop stood still for {loop.page.silence:.2f} s and was ended")
                    loop.kill()
            self._take(loop)
            self._after(loop)
            if first_cycle is not None and time.monotonic() - first_cycle > HEALTHY:
                self._wait = self._settings.backoff[0]
        finally:
            self._loop = None
            loop.close()

    def _take(self, loop: LoopProcess) -> None:
        """Take cycles and events over from the loop."""
        rows = self._reader.drain()
        self._last_state = State(loop.page.state)
        self._tally.add(rows)
        self._recorder.write(rows)
        for event in loop.events():
            self._recorder.tell(event)
            self._hear(event)

    def _hear(self, event: dict[str, Any]) -> None:
        if "failure" in event:
            self._failure = event
        if "to" in event:
            detail = f": {event['detail']}" if event["detail"] else ""
            text = f"{event['from'].lower()} -> {event['to'].lower()} ({event['cause']}){detail}"
            self._say(text)
            self._refused |= event["cause"] == "start refused"
            if event["detail"]:
                self._faults.append(text)
        elif "granted" not in event:
            self._say("; ".join(str(v) for k, v in event.items() if k not in ("time", "input")))

    def _after(self, loop: LoopProcess) -> None:
        """Judge how the loop's process ended; raises where it is no use to start it again."""
        code = loop.exit_code
        if code == Exit.DONE:
            self._stopping.set()
            return
        self._last_state = State.DISCONNECTED
        words = str(self._failure.get("failure", "")) or f"the loop's process {loop.describe_end()}"
        if self._stopping.is_set() and not self._failure:
            return
        if code == Exit.INPUT:
            raise InputError(words)
        if not self._seen:
            raise LinkError(words)
        self._fault(words)

    def _fault(self, words: str) -> None:
        self._faults.append(words)
        self._recorder.tell({"fault": words})
        self._say(words)

    def _summary(self) -> RunSummary:
        state = self._last_state
        wrong = self._refused and not self._tally.written
        wrong |= state in (State.FAULT, State.DISCONNECTED)
        summary = RunSummary(
            **self._tally.figures(),
            restarts=self._restarts,
            lost_rows=self._reader.lost,
            faults=tuple(self._faults),
            state=state.name.lower(),
            exit_code=1 if wrong else 0,
            recording=self._recorder.path,
        )
        self._recorder.tell({"summary": summary.to_json()})
        return summary


class _signals:  # noqa: N801
    """SIGINT and SIGTERM call ``stop`` while the block lasts; only where that is possible."""

    def __init__(self, stop: Callable[[], None]) -> None:
        self._stop = stop
        self._before: dict[int, Any] = {}

    def __enter__(self) -> None:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._before[number] = signal.signal(number, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self._stop()

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
