"""No memory, process, descriptor or thread is left: the daemon goes on, and tries again."""

from __future__ import annotations

import errno
import os
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.run_settings import read_configuration
from gapbridge.bridge.daemon import verification_watch
from gapbridge.bridge.daemon.kept_rests import KeptRests
from gapbridge.bridge.daemon.processes import LoopProcess
from gapbridge.bridge.daemon.verification_watch import VerificationWatch
from gapbridge.bridge.ipc import side_process
from gapbridge.bridge.ipc.command_memory import CommandMemory
from gapbridge.bridge.ipc.shared_memory import RunMemory, SharedMemory
from gapbridge.bridge.ipc.side_process import SideProcess
from gapbridge.drivers.clock import SYSTEM, Clock

CELL = """robot: {model: ur10e}
link: {driver: modbus, profile: ur, host: 127.0.0.1, port: 1}
"""


def refuses(*_: Any, **__: Any) -> Any:
    raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))


def starts_no_thread(_: threading.Thread) -> None:
    raise RuntimeError("can't start new thread")


def descriptors() -> int:
    return len(os.listdir("/proc/self/fd"))


@pytest.fixture
def memory() -> Iterator[SharedMemory]:
    found = SharedMemory(2, clock=SYSTEM)
    yield found
    found.close()


@pytest.fixture
def now() -> list[float]:
    return [1000.0]


@pytest.fixture
def side(
    memory: SharedMemory, now: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[], SideProcess]]:
    """Return what makes a side process; ``now`` is its time, s."""
    (tmp_path / "side_that_waits.py").write_text("import sys\nsys.stdin.read()\nwhile True: ...\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    settings = DaemonSettings(cell=tmp_path / "cell.yaml").model_dump(mode="json")
    order = {"settings": settings, "n": 2, "session": "run-1", "extra": {}}
    clock, made = Clock(), list[SideProcess]()
    clock.monotonic = lambda: now[0]

    def begin() -> SideProcess:
        made.append(SideProcess("side_that_waits", order, memory, clock))
        return made[-1]

    yield begin
    for process in made:
        process.close(0.0)


@pytest.mark.parametrize(
    "short", ["gapbridge.bridge.ipc.side_process.subprocess.Popen",
              "gapbridge.bridge.ipc.side_process.socket.socketpair",
              "gapbridge.bridge.ipc.shared_memory.SharedMemory.open_for_reading"],
)  # fmt: skip
def test_a_side_process_that_cannot_be_started_is_reported_and_tried_again(
    side: Callable[[], SideProcess],
    memory: SharedMemory,
    now: list[float],
    monkeypatch: pytest.MonkeyPatch,
    short: str,
) -> None:
    before = descriptors()
    with monkeypatch.context() as patched:
        patched.setattr(short, refuses)
        one = side()
        problem = f"side_that_waits cannot be started: {os.strerror(errno.EAGAIN)}"
        assert one.check() == problem
        one.emit({"kind": "lost"})
        one.show(memory)
        assert (one.pid, one.events(), one.dropped) == (None, [], 1)
        for pause in (0.2, 0.4, 0.8):
            now[0] += 0.99 * pause
            assert one.check() is None
            now[0] += 0.02 * pause
            assert one.check() == problem
        assert descriptors() == before
    now[0] += side_process.BACKOFF[1]
    assert one.check() is None
    assert one.pid is not None
    assert one.restarts == 4


def test_a_memory_that_could_not_be_shown_is_shown_later(
    side: Callable[[], SideProcess], memory: SharedMemory, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[int] = []
    one = side()
    monkeypatch.setattr(side_process.socket, "send_fds", lambda *given: shown.append(len(given)))
    with monkeypatch.context() as patched:
        patched.setattr(SharedMemory, "open_for_reading", refuses)
        one.show(memory)
    assert not shown
    before = descriptors()
    assert one.check() is None
    assert one.check() is None
    assert shown == [3]  # once
    assert descriptors() == before


@pytest.mark.parametrize(
    "short", ["gapbridge.bridge.daemon.processes.subprocess.Popen",
              "gapbridge.bridge.daemon.processes.sealed_bytes",
              "gapbridge.bridge.ipc.shared_memory.map_as_reader"],
)  # fmt: skip
def test_a_loop_that_cannot_be_started_leaves_nothing_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short: str
) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(CELL)
    configuration = read_configuration(cell)
    memory, commands = RunMemory(6, clock=SYSTEM), CommandMemory()
    order = {"may_write": False, "number": 0, "latched": "", "after": 0}
    before = descriptors()
    with monkeypatch.context() as patched:
        patched.setattr(short, refuses)
        with pytest.raises(OSError, match=os.strerror(errno.EAGAIN)):
            LoopProcess(configuration, memory, commands, order, subprocess.DEVNULL, SYSTEM)
    assert descriptors() == before
    memory.renew()  # and can be used
    memory.close()
    commands.close()


def test_without_a_thread_nobody_knows_of_a_failed_verification(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch = VerificationWatch(tmp_path / "cell.yaml")
    with monkeypatch.context() as patched:
        patched.setattr(verification_watch._Call, "start", starts_no_thread)
        assert watch.look() is None
        assert watch.blocked
    assert watch.look() is None
    assert not watch.blocked


def test_without_a_thread_what_was_learned_of_the_zeros_is_kept_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = KeptRests(SYSTEM)
    kept._path, texts = tmp_path / "rests.json", iter("abc")
    monkeypatch.setattr(kept, "_document", lambda *_: next(texts))
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", starts_no_thread)
        assert kept.step(None, None, at_once=True) == ""  # type: ignore[arg-type]
    kept.step(None, None, at_once=True)  # type: ignore[arg-type]
    assert kept._writing is not None
    kept._writing.join()
    assert (tmp_path / "rests.json").read_text() == "b"
