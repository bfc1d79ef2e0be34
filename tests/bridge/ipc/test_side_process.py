"""Side processes read along; the daemon never waits for them, whatever they do."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from patience import wait_for

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.ipc import side_process
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.ipc.side_process import SideProcess
from gapbridge.drivers.clock import SYSTEM, Clock

ECHO = """
    import os
    from gapbridge.bridge.ipc.side_main import read_start_data

    start = read_start_data()
    reader = start.memory.reader()
    start.emit({"kind": "hello", "session": start.session, "extra": start.extra,
                "cell": str(start.settings.cell), "n": start.n})
    while not start.events.closed:
        start.events.wait(0.05)
        for event in start.events.poll():
            event.pop("filling", None)
            start.emit({"kind": "heard", "of": event})
        rows = reader.drain()
        if len(rows):
            start.emit({"kind": "rows", "timestamps": rows[:, 1].tolist()})
    open(start.extra["last"], "w").write("finished")
"""
DEAF = """
    import time
    from gapbridge.bridge.ipc.side_main import read_start_data

    start = read_start_data()
    start.events.poll()
    start.emit({"kind": "hello"})
    time.sleep(1000)
"""


@pytest.fixture
def memory() -> Iterator[SharedMemory]:
    found = SharedMemory(2, clock=SYSTEM)
    yield found
    found.close()


@pytest.fixture
def start_data(tmp_path: Path) -> dict[str, Any]:
    settings = DaemonSettings(cell=tmp_path / "cell.yaml")
    return {
        "settings": settings.model_dump(mode="json"), "n": 2, "session": "run-1",
        "extra": {"last": str(tmp_path / "last")},
    }  # fmt: skip


@pytest.fixture
def start(
    memory: SharedMemory,
    start_data: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Callable[..., SideProcess]]:
    monkeypatch.syspath_prepend(str(tmp_path))
    started: list[SideProcess] = []

    def begin(text: str, clock: Clock = SYSTEM) -> SideProcess:
        (tmp_path / "side_under_test.py").write_text(textwrap.dedent(text), encoding="utf-8")
        started.append(SideProcess("side_under_test", start_data, memory, clock, sys.stderr))
        return started[-1]

    yield begin
    for side in started:
        side.close(0.0)


@pytest.fixture
def planted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Work in a folder with somebody's ``pickle.py``; returns what it writes when it runs."""
    folder, trace = tmp_path / "shared", tmp_path / "it_ran"
    folder.mkdir()
    (folder / "pickle.py").write_text(f"open({str(trace)!r}, 'w')\nraise SystemExit(7)\n")
    monkeypatch.chdir(folder)
    return trace


def hear(side: SideProcess, kind: str) -> dict[str, Any]:
    found: list[dict[str, Any]] = []

    def heard() -> bool:
        found.extend(event for event in side.events() if event["kind"] == kind)
        return bool(found)

    wait_for(heard, f"the event {kind}")
    return found[0]


def test_it_gets_its_order_the_cycles_and_the_events_and_answers(
    start: Callable[[str], SideProcess], memory: SharedMemory, tmp_path: Path
) -> None:
    side = start(ECHO)
    hello = hear(side, "hello")
    assert (hello["session"], hello["n"]) == ("run-1", 2)
    assert hello["cell"] == str(tmp_path / "cell.yaml")
    assert abs(hello["time"] - time.time()) < 60
    memory.next_row()[1:] = 5.0
    memory.publish()
    assert hear(side, "rows")["timestamps"] == [5.0]
    side.emit({"kind": "transition", "to": "armed"})
    assert hear(side, "heard")["of"] == {"kind": "transition", "to": "armed"}
    assert side.check() is None
    assert side.close() == ([], None)
    assert (tmp_path / "last").read_text() == "finished"
    assert side.pid is None


def test_what_it_says_at_its_end_is_returned_and_that_it_did_not_finish(
    start: Callable[[str], SideProcess],
) -> None:
    last = start(ECHO + '    start.emit({"kind": "recorder", "lost": 7})\n')
    hear(last, "hello")
    events, problem = last.close()
    assert ([event["lost"] for event in events], problem) == ([7], None)
    failed = start(ECHO + "    raise SystemExit(3)\n")
    hear(failed, "hello")
    assert failed.close() == ([], "side_under_test ended with 3")
    stuck = start(DEAF)
    hear(stuck, "hello")
    events, problem = stuck.close(0.1)
    assert problem == "side_under_test did not finish within 0.1 s and was killed"


def test_nobody_waits_until_it_has_read_its_start_data(
    start: Callable[[str], SideProcess], start_data: dict[str, Any]
) -> None:
    start_data["extra"]["text"] = "x" * (1 << 20)  # more than any pipe holds
    reads = (
        "from gapbridge.bridge.ipc.side_main import read_start_data\nstart = read_start_data()\n"
    )
    reads += 'start.emit({"kind": "hello", "size": len(start.extra["text"])})\n'
    assert hear(start(reads), "hello")["size"] == 1 << 20
    begun = time.monotonic()
    start("import time\ntime.sleep(20.0)")
    assert time.monotonic() - begun < 20.0


def test_one_that_is_killed_comes_back_and_the_later_the_more_often(
    start: Callable[..., SideProcess],
) -> None:
    clock, now = Clock(), [1000.0]
    clock.monotonic = lambda: now[0]
    side = start(ECHO, clock)
    hear(side, "hello")
    for pause in (0.2, 0.4, 0.8):
        restart(side, now, pause)
    hear(side, "hello")
    assert side.restarts == 3
    assert side.dropped == 3
    now[0] += side_process.HEALTHY + 1.0  # it ran well for that long: the pause is short again
    assert side.check() is None
    restart(side, now, 0.2)


def restart(side: SideProcess, now: list[float], pause: float) -> None:
    """Kill a side process; it has to be restarted after ``pause`` s of the clock, not before."""
    assert side.pid is not None
    os.kill(side.pid, signal.SIGKILL)
    assert "ended with -9" in wait_for(side.check, "the end of a killed process")
    side.emit({"kind": "lost"})  # to nobody, and nobody waits
    now[0] += 0.99 * pause
    assert side.check() is None
    assert side.pid is None
    now[0] += 0.02 * pause
    assert side.check() is None
    assert side.pid is not None


def test_one_that_does_not_read_loses_events_holds_up_nothing_and_is_ended(
    start: Callable[[str], SideProcess], monkeypatch: pytest.MonkeyPatch
) -> None:
    side = start(DEAF)
    hear(side, "hello")
    begun = time.monotonic()
    for _ in range(2000):
        side.emit({"kind": "status", "filling": "x" * 1000})
    assert time.monotonic() - begun < 20.0
    assert side.dropped > 1000
    monkeypatch.setattr(side_process, "STALLED", 0.3)
    monkeypatch.setattr(side_process, "STARTING", 0.3)
    assert "read nothing" in wait_for(side.check, "the end of a stalled process")
    assert side.stalls == 1
    wait_for(lambda: side.check() is None and side.restarts, "another process")


def test_a_line_is_never_torn_though_the_pipe_was_full(
    start: Callable[[str], SideProcess],
) -> None:
    side = start(ECHO)
    hear(side, "hello")
    assert side.pid is not None
    os.kill(side.pid, signal.SIGSTOP)
    for k in range(400):
        side.emit({"kind": "status", "number": k, "filling": "x" * 3001})
    dropped = side.dropped
    assert dropped > 0
    os.kill(side.pid, signal.SIGCONT)
    heard: list[int] = []

    def all_of_them() -> bool:
        side.emit({"kind": "poke", "number": -1})
        heard.extend(e["of"]["number"] for e in side.events() if e["kind"] == "heard")
        return len([k for k in heard if k >= 0]) == 400 - dropped

    wait_for(all_of_them, "all events that were not dropped")
    numbers = [k for k in heard if k >= 0]
    assert numbers == list(range(400 - dropped))


@pytest.mark.parametrize("text", [ECHO, DEAF])
def test_when_the_daemon_is_killed_they_end(
    text: str, start_data: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "side_under_test.py").write_text(textwrap.dedent(text), encoding="utf-8")
    daemon = f"""
import json, sys, time
sys.path.insert(0, {str(tmp_path)!r})
from gapbridge.bridge.ipc import side_main
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.ipc.side_process import SideProcess
from gapbridge.drivers.clock import SYSTEM, Clock
side = SideProcess("side_under_test", json.loads({json.dumps(start_data)!r}),
    SharedMemory(2, clock=SYSTEM), SYSTEM)
while not side.events():
    time.sleep(0.02)
print(side.pid, flush=True)
time.sleep(1000)
"""
    parent = subprocess.Popen([sys.executable, "-c", daemon], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid = int(parent.stdout.readline())
    parent.kill()
    parent.wait()
    wait_for(lambda: not alive(pid), "its end")


def alive(pid: int) -> bool:
    """Return whether a process runs; one that nobody has waited for yet does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_file_in_the_working_folder_is_not_taken_for_a_module(
    start: Callable[[str], SideProcess], planted: Path
) -> None:
    side = start("import pickle\n" + textwrap.dedent(ECHO))
    wait_for(lambda: planted.exists() or side.events(), "the file or the process")
    assert not planted.exists()


def test_the_loop_imports_nothing_from_the_working_folder(planted: Path) -> None:
    command = [sys.executable, "-m", "gapbridge.bridge.loop.main"]
    environment = side_process.environment()
    code = subprocess.run(command, env=environment, stdin=subprocess.DEVNULL).returncode
    assert (code, planted.exists()) == (1, False)  # 1: it was told nothing, and ends
