"""A test in real time counts where the machine keeps time; else it is skipped, saying how late."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import lateness
import pytest
from lateness import CASES, LIMIT, NOTED, Witness, core_waits, longest_wait

HERE = Path(__file__).parent
FAILING = """
import os, signal, subprocess, sys, time
import pytest
from conftest import WITNESS

def stop():
    WITNESS._process.send_signal(signal.SIGSTOP)
    time.sleep(0.15)
    WITNESS._process.send_signal(signal.SIGCONT)
    time.sleep(0.15)

@pytest.mark.realtime
def test_that_fails_while_the_machine_is_late():
    time.sleep(0.3)
    stop()
    assert False, "late"

@pytest.mark.realtime
def test_that_passes_while_the_machine_is_late():
    stop()

@pytest.fixture(scope="module")
def made_late():
    stop()

@pytest.mark.realtime
def test_first_that_is_given_what_was_made_late(made_late):
    assert False, "made late"

@pytest.mark.realtime
def test_second_that_is_given_what_was_made_late(made_late):
    assert False, "made late"

@pytest.mark.realtime
def test_that_hardly_gets_a_core():
    core = {min(os.sched_getaffinity(0))}
    before, _ = os.sched_getaffinity(0), os.sched_setaffinity(0, core)
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(3)]
    until = time.process_time() + 0.3
    while time.process_time() < until:
        pass
    for other in others:
        other.kill()
        other.wait()
    os.sched_setaffinity(0, before)
    assert False, "no core"

@pytest.mark.realtime(limit=0.5)
def test_that_bears_so_much():
    stop()
    assert False, "borne"

@pytest.mark.realtime
def test_that_sleeps_through_a_busy_time():
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    os.sched_setaffinity(0, before)
    time.sleep(1.0)
    for other in others:
        other.kill()
        other.wait()
    assert False, "slept"

@pytest.mark.realtime
def test_that_fails_for_good_while_the_machine_is_late():
    stop()
    pytest.fail("for good")

@pytest.fixture
def late_before():
    yield
    WITNESS._process.send_signal(signal.SIGSTOP)

def test_before(late_before):
    pass

@pytest.mark.realtime
def test_that_a_late_machine_does_not_begin():
    assert False, "begun"

def test_after():
    WITNESS._process.send_signal(signal.SIGCONT)
    time.sleep(0.5)

@pytest.mark.realtime
def test_that_is_given_nothing():
    assert False, "not late"

def test_that_fails_without_a_clock():
    stop()
    assert False, "wrong"
"""


@pytest.mark.slow
@pytest.mark.realtime
def test_a_failure_counts_unless_the_machine_was_late_and_the_test_in_real_time(
    tmp_path: Path,
) -> None:
    for name in ("conftest.py", "lateness.py", "waiting.py"):
        (tmp_path / name).write_text((HERE / name).read_text(encoding="utf-8"))
    (tmp_path / "test_it.py").write_text(FAILING)
    options = ["-p", "no:cacheprovider", "-o", "markers=realtime: x", "-rsfp"]
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", *options, "--rootdir", str(tmp_path), str(tmp_path)],
        capture_output=True, text=True, check=False, cwd=tmp_path,
    )  # fmt: skip
    found = ran.stdout
    assert re.search(r"SKIPPED.*woke a process 1[0-9]{2} ms late meanwhile.*late", found), found
    assert len(re.findall(r"SKIPPED.*made late", found)) == 2, found
    assert re.search(r"SKIPPED.*(had no core for [0-9]+ ms|woke a process).*: no core", found), (
        found
    )
    assert re.search(r"SKIPPED.*woke a process [0-9]+ ms late just before", found), found
    assert "begun" not in found
    assert "FAILED test_it.py::test_that_bears_so_much" in found
    assert "FAILED test_it.py::test_that_sleeps_through_a_busy_time" in found
    assert "FAILED test_it.py::test_that_fails_for_good_while_the_machine_is_late" in found
    assert "FAILED test_it.py::test_that_is_given_nothing" in found
    assert "PASSED test_it.py::test_that_passes_while_the_machine_is_late" in found
    assert "FAILED test_it.py::test_that_fails_without_a_clock" in found


def test_how_long_a_thread_has_waited_for_a_core_is_the_kernels_count() -> None:
    assert os.sched_getscheduler(0) == os.SCHED_OTHER, "an earlier test kept its priority"
    all_cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(all_cores)})
    spinning = [sys.executable, "-S", "-E", "-c", "print(flush=True)\nwhile True: pass"]
    others = [subprocess.Popen(spinning, stdout=subprocess.PIPE) for _ in range(3)]
    try:
        for other in others:
            assert other.stdout is not None
            other.stdout.readline()  # it has begun
        before, begun = core_waits(), time.monotonic()
        until = time.thread_time() + 0.3
        while time.thread_time() < until:
            pass
        waited, lasted = longest_wait(before), time.monotonic() - begun
    finally:
        os.sched_setaffinity(0, all_cores)
        for other in others:
            other.kill()
            other.communicate()
    # 0.3 s it had the core; other threads of this process may have waited a little longer
    assert 0.3 < waited < lasted - 0.2


def test_who_sleeps_waits_for_no_core() -> None:
    before, begun = core_waits(), time.monotonic()
    time.sleep(0.5)
    assert longest_wait(before) < time.monotonic() - begun - 0.4


def test_a_thread_that_ends_takes_nothing_from_what_the_others_waited() -> None:
    go, done = threading.Event(), threading.Event()

    def work() -> None:
        until = time.thread_time() + 0.2
        while time.thread_time() < until:
            pass
        done.set()
        go.wait()

    other = threading.Thread(target=work)
    other.start()
    done.wait()
    before = core_waits()
    go.set()
    other.join()
    assert longest_wait(before) >= 0.0


def test_nothing_gives_a_test_another_chance() -> None:
    project = (HERE.parent / "pyproject.toml").read_text(encoding="utf-8")
    assert "rerun" not in project
    for path in HERE.rglob("*.py"):
        if path.name != Path(__file__).name:
            assert not re.search(r"\bflaky\b|\breruns\b", path.read_text(encoding="utf-8")), path


def test_few_tests_are_judged_by_the_clock() -> None:
    """Cases as pytest collected them here, before any was deselected: a mark may stand for many."""
    assert len(CASES) <= 45, "\n".join(CASES)


def test_a_core_that_stands_still_is_noticed_while_others_run() -> None:
    witness = Witness()
    witness.start()
    try:
        assert witness._process is not None
        first = witness._process.pid
        below = Path(f"/proc/{first}/task/{first}/children").read_text(encoding="utf-8").split()
        assert len(below) == len(os.sched_getaffinity(0))  # one of them at the pseudo-terminal
        for watcher in (first, *map(int, below)):
            begun = time.time()
            os.kill(watcher, signal.SIGSTOP)
            time.sleep(0.2)
            # on a loaded core it stays asleep for as long after SIGCONT: that counts at once
            assert 0.15 < witness.worst(begun, time.time()) < 2.0
            os.kill(watcher, signal.SIGCONT)
            time.sleep(0.2)
            assert 0.15 < witness.worst(begun, time.time()) < 2.0
        assert witness.worst(time.time() + 10.0, time.time() + 11.0) == 0.0
    finally:
        witness.stop()
    assert NOTED < LIMIT


def test_lines_of_a_stranger_do_not_pass_for_those_of_watchers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """An attacker of another test writes into every pipe; one that began at 0 s would be late."""
    strange = "os.write(1, 9 * b'\\n')\ntime.sleep(0.05)\ndue = time.time()"
    monkeypatch.setattr(
        lateness, "_WATCH", lateness._WATCH.replace("due = time.time()", strange, 1)
    )
    witness = Witness()
    begun = time.time()
    witness.start()
    try:
        assert witness.worst(begun, time.time()) < time.time() - begun
    finally:
        witness.stop()


def test_a_witness_that_has_ended_excuses_nothing() -> None:
    witness = Witness()
    witness.start()
    try:
        assert witness._process is not None
        first = witness._process.pid
        below = Path(f"/proc/{first}/task/{first}/children").read_text(encoding="utf-8").split()
        os.kill(int(below[-1]) if below else first, signal.SIGKILL)
        witness._process.wait(10.0)
        begun = time.time()
        time.sleep(0.2)
        assert witness.worst(begun + 0.15, time.time()) == 0.0
    finally:
        witness.stop()
