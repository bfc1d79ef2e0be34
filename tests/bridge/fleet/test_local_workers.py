"""Local workers: real processes that are killed."""

from __future__ import annotations

import os
import signal
from collections import Counter
from pathlib import Path

import pytest

from gapbridge.bridge.fleet.task import CRASHED, DIED, DONE, Outcome
from gapbridge.bridge.fleet.workers.local_workers import LocalWorkers
from tests.bridge.fleet.fleet_in import tasks_in
from tests.bridge.fleet.jobs import count_rows, fail, kill_itself


@pytest.mark.slow
def test_every_session_is_done_once_by_both_processes(tmp_path: Path) -> None:
    names = [f"arm{i}/s" for i in range(12)]
    present = tmp_path / "present"
    present.mkdir()
    tasks = tasks_in(tmp_path, names, count_rows, {"present": str(present), "others": 2})
    with LocalWorkers(2) as workers:
        outcomes = list(workers.run(tasks))
    assert sorted(o.session for o in outcomes) == sorted(names)
    assert all(o.state == DONE and o.result["rows"] == 12 for o in outcomes)
    processes = {o.result["process"] for o in outcomes}
    assert len(processes) == 2
    assert os.getpid() not in processes


def test_a_killed_worker_loses_nothing(tmp_path: Path) -> None:
    names = [f"arm{i}/s" for i in range(16)]
    present = tmp_path / "present"
    present.mkdir()
    tasks = []
    for part, others in ((names[:4], 2), (names[4:10], 3), (names[10:], 4)):  # waits for successors
        folder = tmp_path / f"{others}"
        folder.mkdir()
        options = {"present": str(present), "others": others}
        tasks += tasks_in(folder, part, count_rows, options)
    outcomes: list[Outcome] = []
    killed: list[int] = []
    with LocalWorkers(2) as workers:
        for outcome in workers.run(tasks):
            outcomes.append(outcome)
            process = outcome.result["process"]
            if len(killed) < 2 and len(outcomes) >= (3, 7)[len(killed)] and process not in killed:
                os.kill(process, signal.SIGKILL)
                killed.append(process)
    assert Counter(o.session for o in outcomes) == Counter(names)
    assert {o.state for o in outcomes} == {DONE}
    assert len({o.result["process"] for o in outcomes}) == 4


@pytest.mark.slow
def test_a_session_that_kills_twice_is_reported_and_the_others_are_done(tmp_path: Path) -> None:
    book = tmp_path / "book"
    names = ["a/killer", "b/once", *(f"c/s{i}" for i in range(6))]
    tasks = tasks_in(tmp_path, names, kill_itself, {"book": str(book)})
    with LocalWorkers(2) as workers:
        outcomes = {o.session: o for o in workers.run(tasks)}
    assert set(outcomes) == set(names)
    killer = outcomes.pop("a/killer")
    assert killer.state == DIED
    assert "killer.csv: 2 workers died" in killer.error
    assert {o.state for o in outcomes.values()} == {DONE}
    runs = Counter(book.read_text().split())
    assert runs["killer"] == 2
    assert runs["once"] == 2


def test_an_unforeseen_error_becomes_one_line_and_harms_nobody_else(tmp_path: Path) -> None:
    tasks = tasks_in(tmp_path, ["a/odd", "a/even"], fail)
    with LocalWorkers(1) as workers:
        outcomes = {o.session: o for o in workers.run(tasks)}
    odd = outcomes["a/odd"]
    assert odd.state == CRASHED
    assert odd.error.endswith("odd.csv: ZeroDivisionError: the odd one")
    assert "Traceback" in odd.details
    assert outcomes["a/even"].state == DONE


def test_workers_import_nothing_from_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("pickle", "yaml", "core"):
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')\n")
    monkeypatch.chdir(tmp_path)
    with LocalWorkers(1) as workers:
        (outcome,) = workers.run(tasks_in(tmp_path, ["a/s"], count_rows))
    assert outcome.state == DONE
    assert not (tmp_path / "imported").exists()
