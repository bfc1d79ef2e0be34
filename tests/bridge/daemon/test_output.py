"""A stopped terminal or an unread pipe keeps nobody waiting: no disarm, no stop, no end."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import termios
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest
from daemon_cell import Robot, ask_again
from patience import PATIENCE, wait_for

from gapbridge.bridge.daemon import output, run
from gapbridge.bridge.daemon.output import Output
from gapbridge.drivers.clock import SYSTEM


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    with Robot(tmp_path) as found:
        yield found


def test_lines_are_written_in_order_and_the_end_waits_for_them() -> None:
    written: list[str] = []
    lines = Output(written.append, SYSTEM)
    say, log = lines.behind(written.append), lines.behind(lambda n: written.append(str(n)))
    for n in range(100):
        say(f"line {n}")
        log(n)
    assert lines.close(PATIENCE)
    assert written == [text for n in range(100) for text in (f"line {n}", str(n))]


def test_what_is_blocked_blocks_nobody_and_what_is_left_out_is_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(output, "MOST_WAITING", 5)
    written, opened = list[str](), threading.Event()
    lines = Output(written.append, SYSTEM)
    begun = threading.Event()

    def blocked(text: str) -> None:
        begun.set()
        opened.wait(5.0)
        written.append(text)

    say = lines.behind(blocked)
    say("0")
    assert begun.wait(PATIENCE)  # the thread has taken it, and stands
    for n in range(1, 9):
        say(str(n))
    assert not lines.close(0.01)
    opened.set()
    wait_for(lambda: len(written) == 7, "what was kept")
    assert written == ["0", "3 lines left out: output was blocked", "1", "2", "3", "4", "5"]
    assert lines.close(PATIENCE)


def test_a_reader_that_has_left_ends_nothing() -> None:
    written: list[str] = []

    def fails(_: str) -> None:
        raise BrokenPipeError

    lines = Output(written.append, SYSTEM)
    lines.behind(fails)("lost")
    lines.behind(written.append)("kept")
    assert lines.close(PATIENCE)
    assert written == ["kept"]


def test_a_terminal_stopped_by_ctrl_s_keeps_no_disarm_waiting(robot: Robot) -> None:
    cell = robot.cell()
    ours, theirs = pty.openpty()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    process = subprocess.Popen(
        [sys.executable, "-m", "gapbridge", "run", str(cell)], cwd=robot.folder, env=environment,
        stdout=theirs, stderr=theirs,
    )  # fmt: skip
    try:
        wait_for(lambda: b"observing" in os.read(ours, 1000), "the link")
        termios.tcflow(theirs, termios.TCOOFF)  # as Ctrl-S does
        assert ask_again(cell, "arm") == "compensating"
        assert ask_again(cell, "disarm").endswith(("observing", "observing already"))
        process.send_signal(signal.SIGTERM)
        assert process.wait(30.0) == 0
    finally:
        termios.tcflow(theirs, termios.TCOON)
        process.kill()
        process.wait()
        os.close(ours)
        os.close(theirs)


def test_no_terminal_suspends_a_daemon_whose_loop_would_go_on() -> None:
    """Ctrl-Z, and a background process on a terminal with tostop: nobody could disarm the arm."""
    calls: list[str] = []

    class Stopped:
        def stop(self) -> None:
            calls.append("stop")

        def reload(self) -> None:
            calls.append("reload")

    before = {number: signal.getsignal(number) for number in (signal.SIGTSTP, *run.TERMINAL)}
    with run._signals(cast("Any", Stopped())):
        for number in before:
            assert signal.getsignal(number) is not signal.SIG_DFL  # else this process stops here
            signal.raise_signal(number)
        assert calls == ["stop"]
    assert {number: signal.getsignal(number) for number in before} == before


SIGNALLED = """\
import os, signal, sys
from gapbridge.bridge.daemon.run import _signals

if sys.argv[2] == "nohup":
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
os.open(sys.argv[1], os.O_RDWR)  # a session's leader: its controlling terminal

class Daemon:
    stop = lambda self: print("stop", flush=True)
    reload = lambda self: print("reload", flush=True)
    note = lambda self, event: print(event["detail"], flush=True)

with _signals(Daemon()):
    print("ready", flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize(
    ("started", "hangs_up"),
    [("at a terminal", ["its terminal is gone: it ends", "stop"]), ("nohup", ["reload"])],
)
def test_a_terminal_that_is_lost_ends_a_run_and_any_other_hangup_is_a_reload(
    started: str, hangs_up: list[str]
) -> None:
    """The arm would compensate on, with whatever the cell file holds then, seen by nobody."""
    ours, theirs = pty.openpty()
    name = os.ttyname(theirs)
    process = subprocess.Popen(
        [sys.executable, "-c", SIGNALLED, name, started], start_new_session=True, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    with process:
        assert process.stdin is not None
        assert process.stdout is not None
        said = process.stdout
        try:
            assert said.readline() == "ready\n"
            process.send_signal(signal.SIGHUP)  # of kill: the terminal is there
            assert said.readline() == "reload\n"
            os.close(theirs)
            os.close(ours)
            for line in hangs_up:
                assert said.readline().strip() == line
        finally:
            process.stdin.close()
