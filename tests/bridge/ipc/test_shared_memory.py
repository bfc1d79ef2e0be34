"""The memory that outlives the loop's processes, and its readers."""

from __future__ import annotations

import errno
import os
import socket
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from gapbridge.bridge.ipc.loop_counters import LoopCounter
from gapbridge.bridge.ipc.shared_memory import ROWS, FollowedMemory, Phase, RunMemory, SharedMemory
from gapbridge.drivers.clock import SYSTEM


@pytest.fixture
def memory() -> Iterator[SharedMemory]:
    found = SharedMemory(2, clock=SYSTEM)
    yield found
    found.close()


def put(memory: SharedMemory, timestamp: float) -> None:
    memory.next_row()[1:] = timestamp
    memory.publish()


def test_each_reader_has_its_own_place(memory: SharedMemory) -> None:
    early = memory.reader()
    put(memory, 0.0)
    assert early.drain()[:, 1].tolist() == [0]
    put(memory, 1.0)
    late = memory.reader(first=1)
    assert early.drain()[:, 1].tolist() == [1]
    assert late.drain()[:, 1].tolist() == [1]
    assert early.lost == late.lost == 0


def loop_of(run: RunMemory) -> SharedMemory:
    """Return the memory as the next process of the loop joins it."""
    run.renew()
    return SharedMemory(2, os.dup(run.fd), clock=SYSTEM)


@pytest.fixture
def run() -> Iterator[RunMemory]:
    found = RunMemory(2, clock=SYSTEM)
    yield found
    found.close()


def test_a_new_process_of_the_loop_goes_on_counting_and_nothing_else_stays(run: RunMemory) -> None:
    reader, loop = run.reader(), loop_of(run)
    loop.enter(Phase.RUNNING)
    loop.note_state(3)
    loop.note_state_read()
    loop.note_ended()
    loop.note_taken(7)
    loop.count(LoopCounter.LATE, 4)
    put(loop, 0.0)
    loop.next_row()[1] = 99.0  # killed here
    loop.close()
    loop = loop_of(run)
    assert (run.phase, run.state, run.has_state, run.ended) == (Phase.STARTING, 0, False, False)
    assert run.silence == 0.0
    assert run.last_taken == 7
    loop.count(LoopCounter.LATE)
    put(loop, 1.0)
    assert reader.drain()[:, 1].tolist() == [0, 1]
    assert run.written == 2
    assert run.counts()[LoopCounter.LATE.label] == 5
    loop.close()


def test_memory_is_shown_once_its_loop_alone_can_write_to_it(run: RunMemory) -> None:
    assert not run.promote()
    first = run.open_for_reading()
    run.renew()
    assert not run.promote()  # its loop is still starting
    assert os.path.sameopenfile(first, run.open_for_reading())
    loop = SharedMemory(2, os.dup(run.fd), clock=SYSTEM)
    assert run.promote()
    assert not run.promote()
    assert os.path.sameopenfile(run.fd, run.open_for_reading())
    with pytest.raises(PermissionError):
        SharedMemory(2, os.dup(run.fd), clock=SYSTEM)
    loop.close()


def test_what_is_shown_is_never_a_closed_file(
    run: RunMemory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where no descriptor is left (EMFILE), or the daemon ends between two steps."""

    def none_left(_: int) -> int:
        raise OSError(errno.EMFILE, "Too many open files")

    run.renew()
    loop = SharedMemory(2, os.dup(run.fd), clock=SYSTEM)
    monkeypatch.setattr(os, "dup", none_left)
    assert run.promote()
    assert os.path.sameopenfile(run.fd, run.open_for_reading())
    loop.close()


def test_who_reads_along_changes_over_and_misses_nothing(run: RunMemory) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    side = FollowedMemory(2, run.open_for_reading(), theirs, clock=SYSTEM)
    reader = side.reader()
    for k in range(3):
        loop = loop_of(run)
        put(loop, 2.0 * k)
        assert run.promote()
        fd = run.open_for_reading()
        socket.send_fds(ours, [b"p"], [fd])
        os.close(fd)
        put(loop, 2.0 * k + 1)
        if k != 1:  # it may be slow, and two memories come at once
            assert reader.drain()[-1, 1] == 2.0 * k + 1
        loop.note_state(k)
        loop.close()
    assert reader.next == 6
    assert reader.lost == 0
    assert side.state == 2
    ours.close()
    assert len(reader.drain()) == 0
    side.close()


def test_a_reader_that_starts_late_counts_what_is_gone(memory: SharedMemory) -> None:
    for k in range(ROWS + 10):
        put(memory, float(k))
    reader = memory.reader(first=5)
    rows = reader.drain()
    assert len(rows) + reader.lost == ROWS + 5
    assert (np.diff(rows[:, 0]) == 1).all()


def test_who_only_reads_cannot_write(memory: SharedMemory) -> None:
    put(memory, 7.0)
    fd = memory.open_for_reading()
    code = f"""
import mmap, os
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.drivers.clock import SYSTEM
memory = SharedMemory(2, {fd}, writable=False, clock=SYSTEM)
assert memory.reader().drain()[:, 1].tolist() == [7.0]
again = os.open("/proc/self/fd/{fd}", os.O_RDWR)
ways = (lambda: memory.note_state(3), lambda: os.write({fd}, b"x"), lambda: mmap.mmap({fd}, 64),
        lambda: os.pwrite(again, b"x", 0), lambda: mmap.mmap(again, 64),
        lambda: os.ftruncate(again, 0), lambda: SharedMemory(2, again, clock=SYSTEM))
for way in ways:
    try:
        way()
    except (OSError, ValueError):
        continue
    raise SystemExit("written")
"""
    done = subprocess.run(
        [sys.executable, "-c", code], pass_fds=[fd], check=False, stderr=subprocess.PIPE
    )
    os.close(fd)
    assert done.returncode == 0, done.stderr
    assert memory.state == 0
