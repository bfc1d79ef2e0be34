"""The command in a process of its own: begun anew, or forked from this one."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import BinaryIO

from gapbridge.bridge.cli import main

PYTHON = (sys.executable, "-m", "gapbridge")
TYPED = b"\n\n"  # the loads hang


@dataclass
class Child:
    """A process that leads a group of its own."""

    pid: int
    typed: BinaryIO
    shown: BinaryIO

    def close(self) -> None:
        """Wait for its end, which somebody has seen to."""
        with contextlib.suppress(ChildProcessError):
            os.waitpid(self.pid, 0)
        self.typed.close()
        self.shown.close()


Start = Callable[[Sequence[str]], Child]


def environment() -> dict[str, str]:
    """Return the environment with this process's way to its modules."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}


def started(arguments: Sequence[str]) -> Child:
    """Begin the command anew."""
    typed, shown = os.pipe(), os.pipe()
    process = subprocess.Popen(
        [*PYTHON, *arguments], stdin=typed[0], stdout=shown[1], stderr=subprocess.STDOUT,
        env=environment(), start_new_session=True,
    )  # fmt: skip
    process.returncode = 0  # ``Child`` waits for it
    return _child(process.pid, typed, shown)


def forked(arguments: Sequence[str]) -> Child:
    """Begin the command in a copy of this process, which must have one thread only."""
    typed, shown = os.pipe(), os.pipe()
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        try:
            _become(arguments, typed, shown)
        finally:
            os._exit(70)
    with contextlib.suppress(PermissionError, ProcessLookupError):
        os.setpgid(pid, pid)  # it does so itself; a kill may come sooner
    return _child(pid, typed, shown)


def _child(pid: int, typed: tuple[int, int], shown: tuple[int, int]) -> Child:
    os.close(typed[0])
    os.close(shown[1])
    hands = os.fdopen(typed[1], "wb", buffering=0)
    hands.write(TYPED)
    return Child(pid, hands, os.fdopen(shown[0], "rb"))


def _become(arguments: Sequence[str], typed: tuple[int, int], shown: tuple[int, int]) -> None:
    """Run the command on the pipes' ends; never returns."""
    os.setpgid(0, 0)
    for number, end in ((0, typed[0]), (1, shown[1]), (2, shown[1])):
        os.dup2(end, number)
    for end in (*typed, *shown):
        os.close(end)
    sys.stdin = io.TextIOWrapper(os.fdopen(0, "rb"), encoding="utf-8")
    sys.stdout = io.TextIOWrapper(os.fdopen(1, "wb"), encoding="utf-8")
    sys.stderr = io.TextIOWrapper(os.fdopen(2, "wb"), encoding="utf-8", line_buffering=True)
    main(list(arguments))
