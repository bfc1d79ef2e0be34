"""The journal keeps finished outcomes when a run is interrupted."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.patch.arms import UR_JOINTS, urdf
from gapbridge.bridge.cell import Cell
from gapbridge.bridge.fleet.cell_source import OneCell
from gapbridge.bridge.fleet.journal import Journal
from gapbridge.bridge.fleet.runner import make_tasks, run
from gapbridge.bridge.fleet.session import find_sessions
from gapbridge.bridge.fleet.task import BAD, DIED, DONE, Outcome, Task, run_task
from gapbridge.bridge.fleet.workers.workers import Workers
from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import RunError
from gapbridge.core.log.log import Log
from gapbridge.drivers.clock import SYSTEM
from tests.bridge.fleet.fleet_in import logs_in, tasks_in
from tests.bridge.fleet.jobs import count_rows


def outcome(key: str, state: str = DONE) -> Outcome:
    return Outcome(key, "arm", f"arm/{key}", "log.csv", "cell.yaml", state, 0.1)


def test_what_was_added_is_known_to_the_next_run(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    with Journal(path, clock=SYSTEM) as journal:
        journal.add(outcome("a"))
    with Journal(path, clock=SYSTEM) as journal:
        assert journal.known("a") == outcome("a")
        assert journal.known("b") is None


def test_a_line_that_was_cut_off_is_taken_away_and_the_rest_kept(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    with Journal(path, clock=SYSTEM) as journal:
        journal.add(outcome("a"))
        journal.add(outcome("b"))
    whole = path.read_bytes()
    path.write_bytes(whole[:-7])
    with Journal(path, clock=SYSTEM) as journal:
        assert journal.known("a") is not None
        assert journal.known("b") is None
        journal.add(outcome("b"))
    assert path.read_bytes() == whole


def test_a_line_whose_key_is_no_text_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    with Journal(path, clock=SYSTEM) as journal:
        journal.add(outcome("a"))
        journal.add(outcome("b"))
    path.write_bytes(path.read_bytes().replace(b'"key":"a"', b'"key":["a"]'))
    assert b'["a"]' in path.read_bytes()
    with Journal(path, clock=SYSTEM) as journal:
        assert journal.known("a") is None
        assert journal.known("b") == outcome("b")


def test_two_runs_do_not_write_one_journal(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    with Journal(path, clock=SYSTEM), pytest.raises(RunError, match="another run writes it"):
        Journal(path, clock=SYSTEM)


def test_a_disk_that_is_full_names_the_journal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    journal = Journal(tmp_path / "j.jsonl", clock=SYSTEM)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(RunError, match=r"j\.jsonl: cannot be written: No space left"), journal:
        pass


def test_fresh_forgets(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    with Journal(path, clock=SYSTEM) as journal:
        journal.add(outcome("a"))
    with Journal(path, fresh=True, clock=SYSTEM) as journal:
        assert journal.known("a") is None


class InProcess(Workers):
    """Runs the tasks in this process and records their sessions."""

    def __init__(self) -> None:
        self.given: list[str] = []

    def start(self) -> None: ...

    def stop(self) -> None: ...

    def description(self) -> str:
        return "this process"

    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        for task in tasks:
            self.given.append(task.session)
            yield run_task(task)


def resumed(tasks: list[Task], path: Path) -> list[str]:
    """Run the tasks and return the sessions that were not resumed."""
    workers = InProcess()
    with Journal(path, clock=SYSTEM) as journal:
        run(tasks, [], workers, journal, lambda outcome: None)
    return workers.given


def test_a_run_goes_on_where_it_was_broken_off_and_redoes_what_has_changed(tmp_path: Path) -> None:
    names = ["a/s1", "a/s2", "b/s1"]
    tasks = tasks_in(tmp_path, names, count_rows)
    path = tmp_path / "j.jsonl"
    with Journal(path, clock=SYSTEM) as journal:
        # as if broken off: one done, one bad, one whose workers died
        for task, state in zip(tasks, (DONE, BAD, DIED), strict=True):
            journal.add(Outcome(task.key, task.arm, task.session, "", "", state, 0.1))
    assert resumed(tasks, path) == ["b/s1"]
    log = tasks[0].log
    log.write_text(log.read_text() + log.read_text().splitlines()[-1] + "\n")
    sessions = find_sessions([str(tmp_path / "logs")]).sessions
    again, _ = make_tasks(sessions, OneCell(tmp_path / "cell.yaml"), count_rows, {})
    assert resumed(again, path) == ["a/s1"]
    other, _ = make_tasks(
        sessions, OneCell(tmp_path / "cell.yaml"), count_rows, {"withhold": ["x"]}
    )
    assert {t.key for t in other}.isdisjoint({t.key for t in again})


def flange_height(cell: Cell, log: Log, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the height of the flange at zero angles of the arm that a worker has read, m."""
    return {"height": float(np.linalg.multi_dot(cell.arm.link_in_link)[2, 3])}


@pytest.mark.parametrize("kind", ["urdf", "calibration"])
def test_a_file_that_the_cell_names_is_part_of_the_cell(tmp_path: Path, kind: str) -> None:
    arm = builtin_arm("ur10e")
    taller = arm.link_in_link.copy()
    taller[0, 2, 3] += 0.01
    if kind == "urdf":
        robot = "{urdf: file}"
        states = [urdf(a, UR_JOINTS) for a in (arm, replace(arm, link_in_link=taller))]
    else:
        robot = "{model: ur10e, calibration: file}"
        states = [f"[mounting]\ndelta_d = [{d}, 0, 0, 0, 0, 0]\n" for d in (0.0, 0.01)]
    cell, sessions = tmp_path / "cell.yaml", find_sessions([str(logs_in(tmp_path, ["a/s"]))])
    cell.write_text(f"robot: {robot}\n")
    path, runs = tmp_path / "j.jsonl", []
    for k, text in enumerate((states[0], None, states[1])):
        if text is not None:
            (tmp_path / "file").write_text(text)
            os.utime(tmp_path / "file", ns=(k, k))
        tasks, bad = make_tasks(sessions.sessions, OneCell(cell), flange_height, {})
        assert not bad
        runs.append(resumed(tasks, path))
    assert runs == [["a/s"], [], ["a/s"]]
    before, after = (json.loads(line) for line in path.read_text().splitlines())
    assert after["result"]["height"] - before["result"]["height"] == pytest.approx(0.01)


def test_another_version_of_gapbridge_computes_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = tasks_in(tmp_path, ["a/s1"], count_rows)
    monkeypatch.setattr("gapbridge.bridge.fleet.runner.installed_version", lambda: "99.0")
    new, _ = make_tasks(
        find_sessions([str(tmp_path / "logs")]).sessions,
        OneCell(tmp_path / "cell.yaml"), count_rows, {},
    )  # fmt: skip
    assert old[0].key != new[0].key
