"""Running a daemon from a cell: signals, output on the terminal, exit code."""

from __future__ import annotations

import gc
import signal
import threading
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import Any

import click

from gapbridge.bridge.cell import Cell, load_cell
from gapbridge.bridge.cell.run_settings import Configuration, read_configuration
from gapbridge.bridge.daemon.daemon import Daemon, Say
from gapbridge.bridge.daemon.output import Output
from gapbridge.bridge.daemon.runnable import require_runnable
from gapbridge.bridge.daemon.summary import RunSummary
from gapbridge.bridge.ipc.events import Event
from gapbridge.drivers.clock import SYSTEM

LONGEST_OUTPUT = 1.0  # s that the end waits for a blocked terminal or pipe


def run_cell(
    cell: Cell | Path,
    observe: bool = False,
    arm: bool = False,
    duration: float | None = None,
    log: Callable[[Event], None] | None = None,
) -> int:
    """Run a cell's daemon until it is stopped, its trajectory ends or ``duration`` s are over.

    Prints what happens and a summary; returns the exit code. Raises InputError for a cell that
    cannot be run, LinkError where the robot cannot be reached. ``log`` gets every event.
    """
    cell = cell if isinstance(cell, Cell) else load_cell(cell)
    configuration = read_configuration(cell.path)
    require_runnable(cell, configuration.settings, SYSTEM)
    output = Output(click.echo, SYSTEM)
    echo = output.behind(click.echo)
    try:
        summary = run_daemon(
            configuration, observe, arm, duration, lambda text: echo(_with_time(text)),
            None if log is None else output.behind(log),
        )  # fmt: skip
        for line in summary.lines():
            echo(line)
    finally:
        output.close(LONGEST_OUTPUT)
    gc.freeze()  # else Python's last collection, of all compiled code, delays the end by 0.5 s
    return summary.exit_code


def _with_time(text: str) -> str:
    now = datetime.fromtimestamp(SYSTEM.time())
    return f"{now:%H:%M:%S}.{now.microsecond // 1000:03d} {text}"


def run_daemon(
    configuration: Configuration,
    observe: bool = False,
    arm: bool = False,
    duration: float | None = None,
    say: Say = lambda _: None,
    log: Callable[[Event], None] | None = None,
) -> RunSummary:
    """Run the daemon and return how it went; see ``run_cell``.

    Stops on SIGINT and SIGTERM, reads the cell file again on SIGHUP.
    """
    daemon = Daemon(configuration, not observe, SYSTEM, say, log)
    by = "--arm" if arm else "the cell file"
    wanted = not observe and (arm or configuration.settings.setpoints.arm)
    with _signals(daemon):
        return daemon.run(arm=wanted, duration=duration, by=by)


class _signals:  # noqa: N801
    """Signals reach the daemon while the block lasts; only where that is possible."""

    def __init__(self, daemon: Daemon) -> None:
        self._calls = {
            signal.SIGINT: daemon.stop, signal.SIGTERM: daemon.stop, signal.SIGHUP: daemon.reload,
        }  # fmt: skip
        self._before: dict[int, Any] = {}

    def __enter__(self) -> None:
        if threading.current_thread() is threading.main_thread():
            for number in self._calls:
                self._before[number] = signal.signal(number, self._handle)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self._calls[signal.Signals(number)]()

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
