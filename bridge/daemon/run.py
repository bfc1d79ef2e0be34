"""Running a daemon from a cell: signals, output on the terminal, exit code."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import threading
from collections.abc import Callable
from datetime import datetime
from types import FrameType
from typing import Any

import click

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.run_settings import read_configuration
from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.daemon.output import Output
from gapbridge.bridge.daemon.runnable import require_runnable
from gapbridge.bridge.ipc.events import Event, EventKind
from gapbridge.drivers.clock import SYSTEM

TERMINAL = (signal.SIGTTIN, signal.SIGTTOU)
"""Signals of a terminal that stop a process in the background where it reads or writes there."""
LONGEST_OUTPUT = 1.0  # s that the end waits for a blocked terminal or pipe


def run_cell(
    cell: Cell,
    observe: bool = False,
    arm: bool = False,
    duration: float | None = None,
    log: Callable[[Event], None] | None = None,
) -> int:
    """Run a cell's daemon until it is stopped, its trajectory ends or ``duration`` s are over.

    Prints what happens and a summary; returns the exit code. SIGINT, SIGTERM, SIGTSTP (Ctrl-Z) and
    the loss of its terminal stop it, any other SIGHUP reads the cell file again. ``log`` gets every
    event. Raises InputError for a cell that cannot be run, LinkError where the robot cannot be
    reached.
    """
    configuration = read_configuration(cell.path)
    require_runnable(cell, configuration.settings, SYSTEM)
    output = Output(click.echo, SYSTEM)
    echo = output.behind(click.echo)
    try:
        daemon = Daemon(
            configuration, not observe, SYSTEM, lambda text: echo(_with_time(text)),
            None if log is None else output.behind(log),
        )  # fmt: skip
        wanted = not observe and (arm or configuration.settings.setpoints.arm)
        with _signals(daemon):
            summary = daemon.run(
                arm=wanted, duration=duration, by="--arm" if arm else "the cell file"
            )
        for line in summary.lines():
            echo(line)
    finally:
        output.close(LONGEST_OUTPUT)
    gc.freeze()  # else Python's last collection, of all compiled code, delays the end by 0.5 s
    return summary.exit_code


def _with_time(text: str) -> str:
    now = datetime.fromtimestamp(SYSTEM.time())
    return f"{now:%H:%M:%S}.{now.microsecond // 1000:03d} {text}"


def _terminal() -> bool:
    """Return whether this process has a controlling terminal."""
    with contextlib.suppress(OSError):
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY | os.O_CLOEXEC))
        return True
    return False


class _signals:  # noqa: N801
    """Signals reach the daemon while the block lasts; only where that is possible.

    None suspends it: its loop would go on to move the arm, and nobody could disarm. A closed
    window or a lost ssh is Ctrl-C as well: nobody sees any more what the arm does. nohup keeps
    that off; every SIGHUP is then a reload.
    """

    def __init__(self, daemon: Daemon) -> None:
        self._daemon = daemon
        self._has_terminal = signal.getsignal(signal.SIGHUP) != signal.SIG_IGN and _terminal()
        self._calls = {
            signal.SIGINT: daemon.stop, signal.SIGTERM: daemon.stop, signal.SIGTSTP: daemon.stop,
            signal.SIGHUP: self._hang_up,
        }  # fmt: skip
        self._before: dict[int, Any] = {}

    def __enter__(self) -> None:
        if threading.current_thread() is threading.main_thread():
            for number in self._calls:
                self._before[number] = signal.signal(number, self._handle)
            for number in TERMINAL:
                self._before[number] = signal.signal(number, signal.SIG_IGN)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self._calls[signal.Signals(number)]()

    def _hang_up(self) -> None:
        if self._has_terminal and not _terminal():
            self._daemon.note({"kind": EventKind.NOTE, "detail": "its terminal is gone: it ends"})
            self._daemon.stop()
        else:
            self._daemon.reload()

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
