"""A disk that is full, or gets full: recording pauses, is counted, and goes on."""

from __future__ import annotations

import errno
import functools
import os
import resource
import signal
import traceback
from collections.abc import Callable
from pathlib import Path

import pytest
from recorded import Desk, publish
from recorded_documents import read_documents
from test_recorder import numbers

from gapbridge.bridge.recording import recorder as recorder_module


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder_module, "RETRY_EVERY", 0.0)


def in_a_process_of_its_own(test: Callable[[Path], None]) -> Callable[[Path], None]:
    """Run a test in a fork: what the system refuses there, it refuses to nobody else."""

    @functools.wraps(test)
    def apart(tmp_path: Path) -> None:
        child = os.fork()
        if child == 0:
            try:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                test(tmp_path)
            except BaseException:
                allow(resource.RLIM_INFINITY)
                (tmp_path / "failure").write_text(traceback.format_exc(), encoding="utf-8")
                os._exit(1)
            os._exit(0)
        _, status = os.waitpid(child, 0)
        failure = tmp_path / "failure"
        assert status == 0, failure.read_text(encoding="utf-8") if failure.exists() else status

    return apart


def allow(size: int) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))


@pytest.mark.usefixtures("quick")
@in_a_process_of_its_own
def test_a_write_that_fails_in_its_middle_loses_nothing_that_the_ring_holds(
    tmp_path: Path,
) -> None:
    desk = Desk(tmp_path)
    recorder = desk.recorder()
    publish(desk.memory, 100)
    recorder.step(flush=True)
    whole = desk.files[0].stat().st_size
    allow(whole + 5000)  # amidst the next chunk
    publish(desk.memory, 200)
    recorder.take({"time": 5.0, "kind": "note", "detail": "while the disk was full"})
    recorder.step(flush=True)
    assert recorder.path is None
    assert "paused" in desk.events[-1]
    assert desk.files[0].stat().st_size == whole
    assert numbers(desk.stem) == list(range(100))
    allow(resource.RLIM_INFINITY)
    publish(desk.memory, 50)
    recorder.step(flush=True)
    recorder.close()
    assert numbers(desk.stem) == list(range(350))
    assert "while the disk was full" in [e.get("detail") for e in read_documents(desk.stem)]
    assert recorder.lost == 0


@pytest.mark.usefixtures("quick")
@in_a_process_of_its_own
def test_a_disk_that_stays_full_is_reported_once_and_what_is_lost_is_counted(
    tmp_path: Path,
) -> None:
    desk = Desk(tmp_path)
    recorder = desk.recorder()
    publish(desk.memory, 20)
    recorder.step(flush=True)
    allow(100)
    for _ in range(5):
        publish(desk.memory, 20)
        recorder.step(flush=True)
    recorder.close()
    assert recorder.lost == 100
    assert sum("paused" in event for event in desk.events) == 1
    assert numbers(desk.files[0]) == list(range(20))
    assert len(desk.files) == 1  # and no empty one for each retry


@pytest.mark.usefixtures("quick")
def test_a_file_whose_head_cannot_be_synced_is_not_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(fd: int) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    desk = Desk(tmp_path)
    recorder = desk.recorder()
    with monkeypatch.context() as quota:
        quota.setattr(os, "fdatasync", refused)
        for _ in range(3):
            publish(desk.memory, 10)
            recorder.step()
    assert not desk.files
    recorder.close()
    assert numbers(desk.stem) == list(range(30))


@pytest.mark.usefixtures("quick")
@in_a_process_of_its_own
def test_what_a_paused_recorder_loses_of_a_new_loop_is_counted_at_the_end(tmp_path: Path) -> None:
    desk = Desk(tmp_path)
    recorder = desk.recorder()
    allow(100)
    publish(desk.memory, 20)
    recorder.step(flush=True)
    desk.memory.follow = lambda: publish(desk.memory, 30)  # type: ignore[method-assign]
    recorder.close()
    assert recorder.lost == 50


@pytest.mark.usefixtures("quick")
def test_recording_pauses_before_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(tmp_path, keep_free=50.0)
    room = {"free": 1000.0}
    recorder = desk.recorder()
    monkeypatch.setattr(recorder, "_free_space", lambda: room["free"])
    publish(desk.memory, 20)
    recorder.step(flush=True)
    room["free"] = 40.0
    publish(desk.memory, 20)
    recorder.step(flush=True)  # this one still fits; then the file is finished
    publish(desk.memory, 20)
    recorder.step(flush=True)
    assert recorder.path is None
    assert numbers(desk.stem) == list(range(40))
    room["free"] = 1000.0
    recorder.close()
    assert numbers(desk.stem) == list(range(60))
