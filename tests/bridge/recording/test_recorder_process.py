"""The recorder as a process: killed, stalled, left behind; what was published is in the files."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from patience import wait_for
from recorded import SESSION, N
from recorded_documents import read_documents

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.settings.recording import RecordingSettings
from gapbridge.bridge.ipc import side_process
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.ipc.side_process import SideProcess
from gapbridge.core.log.mcap_reading import read_columns, read_configuration
from gapbridge.core.log.mcap_records import is_whole
from gapbridge.drivers.clock import SYSTEM

RATE = 125.0  # the ring then lasts for as long as a busy machine takes to start a process
CELL = "robot: {model: ur10e}\nweb: {token: squeamish}\n"


class Publisher:
    """A loop's half of the shared memory, in a thread of the test."""

    def __init__(self) -> None:
        self.memory = SharedMemory(N, clock=SYSTEM)
        self.stop, self._publishes = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        random = np.random.default_rng(0)
        while not self._publishes.wait(0.005):
            self.memory.beat()
        begun = time.monotonic()
        while not self.stop.is_set():
            self.memory.beat()
            for _ in range(int((time.monotonic() - begun) * RATE) - self.memory.written):
                row = self.memory.next_row()
                row[1:] = random.standard_normal(self.memory.width - 1)
                row[1] = self.memory.written / RATE
                row[self.memory.slices["state"]] = State.OBSERVING
                row[self.memory.slices["received"]] = time.monotonic()
                self.memory.publish()
            time.sleep(0.005)

    def begin(self) -> None:
        """Publish cycles from now on, if not before."""
        self._publishes.set()

    def publish(self, count: int) -> None:
        """Wait until so many more cycles have been published."""
        until = self.memory.written + count
        wait_for(lambda: self.memory.written >= until, f"{count} cycles")

    def end(self) -> int:
        """Stop publishing; returns how many cycles there were."""
        self.stop.set()
        self.begin()
        self._thread.join()
        return self.memory.written


class Recording:
    """A recorder's process, as the daemon has it."""

    def __init__(self, folder: Path, publisher: Publisher) -> None:
        cell = folder / "cell.yaml"
        cell.write_text(CELL)
        self.stem = folder / "recordings" / SESSION
        settings = DaemonSettings(
            cell=cell, recording=RecordingSettings(folder=self.stem.parent, keep_free=0.0)
        )
        start = {"settings": settings.model_dump(mode="json"), "n": N, "session": SESSION,
                 "extra": {}}  # fmt: skip
        self.process = SideProcess(
            "gapbridge.bridge.recording.main", start, publisher.memory, clock=SYSTEM
        )
        self._publisher = publisher
        self._seen = 0  # files of former lives

    def wait_for_file(self) -> None:
        """Wait until this life of the process writes."""

        def writes() -> bool:
            self.process.check()
            self.process.events()
            return self._files() > self._seen

        wait_for(writes, "a file")
        self._seen = self._files()
        self._publisher.begin()

    def wait_for_cycle(self, number: int) -> None:
        """Wait until the files hold a cycle; an end in order takes what is then left to write."""
        wait_for(lambda: number in self.numbers()[-1000:], f"cycle {number} in a file")

    def _files(self) -> int:
        return len(list(self.stem.parent.glob("*.mcap")))

    def end(self) -> None:
        self.process.emit({"kind": "ended", "time": time.time()})
        self.process.close(10.0)

    def numbers(self) -> list[int]:
        return [int(number) for number in read_columns(self.stem).get("number", [])]


@pytest.fixture
def publisher() -> Iterator[Publisher]:
    found = Publisher()
    yield found
    found.end()
    found.memory.close()


@pytest.fixture
def recording(
    tmp_path: Path, publisher: Publisher, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Recording]:
    monkeypatch.setattr(side_process, "BACKOFF", (0.02, 0.05))
    found = Recording(tmp_path, publisher)
    yield found
    found.process.close(0.1)


def test_it_ends_in_order_with_everything_and_without_secrets(
    recording: Recording, publisher: Publisher
) -> None:
    recording.wait_for_file()
    recording.process.emit({"kind": "transition", "time": time.time(), "from": "DISCONNECTED",
                            "to": "OBSERVING", "cause": "connected", "detail": ""})  # fmt: skip
    recording.wait_for_cycle(publisher.memory.written)
    count = publisher.end()
    recording.end()
    assert recording.numbers() == list(range(count))
    assert [event["kind"] for event in read_documents(recording.stem)] == ["transition", "ended"]
    (path,) = recording.stem.parent.glob("*.mcap")
    assert is_whole(path)
    text = read_configuration(recording.stem)["text"]
    assert "ur10e" in text
    assert "squeamish" not in text


def kill_at_random_moments(recording: Recording, publisher: Publisher, times: int) -> None:
    random = np.random.default_rng(5)
    for _ in range(times):
        recording.wait_for_file()
        begun = time.monotonic()
        time.sleep(random.uniform(0.0, 1.8))
        assert recording.process.pid is not None
        os.kill(recording.process.pid, signal.SIGKILL)
        published = publisher.memory.written
        alive = time.monotonic() - begun
        numbers = recording.numbers()
        assert numbers == list(range(len(numbers)))
        if alive > 1.0:
            assert len(numbers) > published - RATE * 1.0
    recording.wait_for_file()
    count = publisher.end()
    recording.end()
    assert recording.numbers() == list(range(count))


@pytest.mark.slow
def test_killed_at_random_moments_it_goes_on_from_the_ring_and_nothing_is_lost(
    recording: Recording, publisher: Publisher
) -> None:
    kill_at_random_moments(recording, publisher, 4)


@pytest.mark.slow
def test_killed_often_nothing_is_lost(recording: Recording, publisher: Publisher) -> None:
    kill_at_random_moments(recording, publisher, 25)


def test_stalled_for_a_while_it_loses_nothing(recording: Recording, publisher: Publisher) -> None:
    recording.wait_for_file()
    pid = recording.process.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    publisher.publish(250)
    os.kill(pid, signal.SIGCONT)
    count = publisher.end()
    recording.wait_for_cycle(count - 1)
    recording.end()
    assert recording.numbers() == list(range(count))


@pytest.mark.slow
def test_a_daemon_that_is_gone_without_an_end_is_outlived_until_the_loop_has_stopped(
    recording: Recording, publisher: Publisher
) -> None:
    recording.wait_for_file()
    assert recording.process.pid is not None
    os.kill(recording.process.pid, signal.SIGTERM)  # as a service manager ends all at once
    recording.process.begin_close()  # as the system does when the daemon is killed
    publisher.publish(125)
    count = publisher.end()
    recording.process.close(10.0)
    assert recording.numbers() == list(range(count))
    assert "gone" in read_documents(recording.stem)[-1]["detail"]
