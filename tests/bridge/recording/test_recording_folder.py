"""The folder of recordings: the order of its files, and which of them make room."""

from __future__ import annotations

import errno
import subprocess
from datetime import datetime
from pathlib import Path

import pytest
from recorded import SESSION, Desk, publish
from test_recorder import numbers

from gapbridge.bridge.recording import folder as folder_module
from gapbridge.bridge.recording.finishing import unfinished
from gapbridge.bridge.recording.folder import (
    RunFiles,
    hold,
    new_session,
    next_path,
    prune,
    segments,
)
from gapbridge.core.errors import InputError, LinkError, RunError
from gapbridge.drivers.clock import SYSTEM

OTHER = "run-20260102-080000"
MB = 1_000_000


def files(folder: Path, session: str, *numbers: int, size: int = MB) -> list[Path]:
    """Write files of a run, cut off before their summary."""
    paths = [folder / f"{session}-{number:03d}.mcap" for number in numbers]
    for path in paths:
        path.write_bytes(bytes(size))
    return paths


def test_the_oldest_of_more_than_a_thousand_files_make_room(tmp_path: Path) -> None:
    paths = files(tmp_path, SESSION, *range(996, 1004))
    assert prune(tmp_path, SESSION, 3.0) == paths[:5]
    assert segments(tmp_path, SESSION) == paths[5:]
    assert next_path(tmp_path, SESSION).name == f"{SESSION}-1004.mcap"


def test_a_run_that_began_in_the_same_second_is_another_one(tmp_path: Path) -> None:
    own, other = files(tmp_path, SESSION, 1), files(tmp_path, f"{SESSION}-2", 1)
    assert prune(tmp_path, SESSION, 1.0) == other
    assert segments(tmp_path, SESSION) == own


def test_files_that_were_cut_off_are_finished_in_the_order_of_their_numbers(
    tmp_path: Path,
) -> None:
    paths = files(tmp_path, SESSION, 998, 999, 1000)
    assert unfinished(tmp_path) == paths


def test_a_file_that_another_daemon_is_writing_does_not_make_room(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    recorder = desk.recorder()
    publish(desk.memory, 20)
    recorder.step(flush=True)
    own = files(tmp_path, OTHER, 1, 2)
    assert prune(tmp_path, OTHER, 0.0) == own
    publish(desk.memory, 10)
    recorder.close()
    assert numbers(desk.stem) == list(range(30))
    written = desk.files
    assert prune(tmp_path, OTHER, 0.0) == written  # nobody writes them any more


def test_a_file_that_another_daemon_has_removed_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (kept,) = files(tmp_path, SESSION, 1)
    listed = [(SESSION, 1, kept), (SESSION, 2, tmp_path / f"{SESSION}-002.mcap")]
    monkeypatch.setattr(folder_module, "recordings", lambda folder: listed)
    assert prune(tmp_path, OTHER, 0.0) == [kept]


def test_daemons_that_begin_in_the_same_second_take_two_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = datetime(2026, 3, 1, 12, 30, 5).timestamp()
    stem = f"{datetime.fromtimestamp(begin):run-%Y%m%d-%H%M%S}"
    other = tmp_path / f"{stem}.loop.log"

    def looks_while_the_other_begins(folder: Path, session: str) -> list[Path]:
        if session == stem:
            other.write_bytes(b"output of the other daemon")
        return []

    monkeypatch.setattr(folder_module, "segments", looks_while_the_other_begins)
    assert new_session(tmp_path, begin) == f"{stem}-2"
    assert other.read_bytes() == b"output of the other daemon"
    assert (tmp_path / f"{stem}-2.loop.log").exists()


def refused(folder: Path, error: Exception, keep: bool = False) -> None:
    """Begin a run that records a file and is refused."""
    with RunFiles(folder, SYSTEM) as run:
        files(folder, run.session, 1)
        if keep:
            run.keep()
        raise error


@pytest.mark.parametrize("error", [InputError("x"), LinkError("x")])
def test_a_run_that_is_refused_at_its_start_leaves_no_files(
    tmp_path: Path, error: Exception
) -> None:
    """A service is started every 2 s while its robot is off: 40,000 a day."""
    other = files(tmp_path, OTHER, 1)
    with pytest.raises(type(error)):
        refused(tmp_path, error)
    assert list(tmp_path.iterdir()) == other


@pytest.mark.parametrize(("error", "keep"), [(RunError("x"), False), (LinkError("x"), True)])
def test_a_run_that_fails_later_keeps_its_files(
    tmp_path: Path, error: Exception, keep: bool
) -> None:
    with pytest.raises(type(error)):
        refused(tmp_path, error, keep)
    assert len(list(tmp_path.iterdir())) == 2


def test_a_run_before_the_clock_is_set_is_no_older_than_those_before_it(tmp_path: Path) -> None:
    """At power up, without a battery, it is 1970: the run of today was the first to make room."""
    old = [*files(tmp_path, OTHER, 1), *files(tmp_path, SESSION, 1, 2)]
    oldest, newest = sorted({OTHER, SESSION})
    for number in range(2, 12):
        assert new_session(tmp_path, 12.0) == f"{newest}-{number}"
    unset = [*files(tmp_path, f"{newest}-2", 1), *files(tmp_path, f"{newest}-11", 1)]
    in_order = sorted(old, key=lambda path: not path.name.startswith(oldest))
    assert prune(tmp_path, "run-20270101-000000", 0.0) == [*in_order, *unset]


def test_the_first_run_of_all_may_be_before_the_clock_is_set(tmp_path: Path) -> None:
    name = new_session(tmp_path, 12.0)
    assert name.startswith(("run-1970", "run-1969"))
    assert new_session(tmp_path, 12.0) == f"{name}-2"


def test_a_disk_without_room_for_a_name_keeps_no_run_from_starting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No inode, or a quota: it was a crash, and of a service one every 2 s."""

    def full(folder: Path, session: str) -> bool:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(folder_module, "_take", full)
    with RunFiles(tmp_path, SYSTEM) as run:
        assert run.session.startswith("run-")
        assert run.log == subprocess.DEVNULL


def test_a_recording_that_is_replayed_does_not_make_room(tmp_path: Path) -> None:
    """With the recorded cell a replay records into the same folder, of which it was the oldest."""
    own = files(tmp_path, OTHER, 1, 2)
    held = hold(tmp_path / OTHER)
    assert prune(tmp_path, SESSION, 0.0) == []
    for file in held:
        file.close()
    assert prune(tmp_path, SESSION, 0.0) == own
