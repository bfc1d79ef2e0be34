"""The page that outlives the loop's processes, and its readers."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from bridge.ipc.shared_memory import ROWS, Command, Page, Phase


@pytest.fixture
def page() -> Iterator[Page]:
    found = Page(2)
    yield found
    found.close()


def put(page: Page, timestamp: float) -> None:
    page.next_row()[1:] = timestamp
    page.publish()


def test_each_reader_has_its_own_place(page: Page) -> None:
    early = page.reader()
    put(page, 0.0)
    assert early.drain()[:, 1].tolist() == [0]
    put(page, 1.0)
    late = page.reader(first=1)
    assert early.drain()[:, 1].tolist() == [1]
    assert late.drain()[:, 1].tolist() == [1]
    assert early.lost == late.lost == 0


def test_a_new_process_of_the_loop_goes_on_counting_and_nothing_else_stays(page: Page) -> None:
    reader = page.reader()
    page.enter(Phase.RUNNING)
    page.tell_state(3)
    page.tell_seen()
    page.tell_ended()
    page.ask(Command.STOP)
    put(page, 0.0)
    page.next_row()[1] = 99.0  # killed here
    page.renew()
    assert (page.phase, page.state, page.seen, page.ended) == (Phase.STARTING, 0, False, False)
    assert page.silence == 0.0
    assert page.take_command() == Command.NONE
    put(page, 1.0)
    assert reader.drain()[:, 1].tolist() == [0, 1]
    assert page.written == 2


def test_a_reader_that_starts_late_counts_what_is_gone(page: Page) -> None:
    for k in range(ROWS + 10):
        put(page, float(k))
    reader = page.reader(first=5)
    rows = reader.drain()
    assert len(rows) + reader.lost == ROWS + 5
    assert (np.diff(rows[:, 0]) == 1).all()


def test_who_only_reads_cannot_write_nor_command(page: Page) -> None:
    put(page, 7.0)
    fd = page.open_for_reading()
    code = f"""
import mmap, os
from bridge.ipc.shared_memory import Command, Page
page = Page(2, {fd}, writable=False)
assert page.reader().drain()[:, 1].tolist() == [7.0]
for attempt in (lambda: page.ask(Command.ARM), lambda: os.write({fd}, b"x"),
                lambda: mmap.mmap({fd}, 64)):
    try:
        attempt()
    except (OSError, ValueError):
        continue
    raise SystemExit("written")
"""
    done = subprocess.run(
        [sys.executable, "-c", code], pass_fds=[fd], check=False, stderr=subprocess.PIPE
    )
    os.close(fd)
    assert done.returncode == 0, done.stderr
    assert page.take_command() == Command.NONE
