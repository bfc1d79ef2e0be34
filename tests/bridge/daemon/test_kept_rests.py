"""What the watch over the joints' zeros keeps: over lost links, and from run to run."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated_daemon import ask, rides_on_a_program, until

from benchmarks.simulation.links import setting_of
from benchmarks.simulation.world import SimulatedClock, World
from benchmarks.zero_slips import COUNTS, SETUPS, SLICES, Program, found_in
from gapbridge.bridge.cell.run_settings import Configuration
from gapbridge.bridge.cell.runtime_folder import state_folder
from gapbridge.bridge.daemon import kept_rests
from gapbridge.bridge.daemon.kept_rests import EVERY, KeptRests
from gapbridge.bridge.daemon.slip_watch import SlipWatch, slip_event
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.core.diagnosis.rests.rest_comparison import Slip
from gapbridge.core.errors import InputError
from gapbridge.drivers.clock import SYSTEM

LEARNING, ROUNDS = 6 * COUNTS, 2 * COUNTS + 1  # rests
FOUND = slip_event(Slip((4, 3), 0.0098, 0.0007, 12.0, 4))
ACKNOWLEDGED = {"kind": "request", "acknowledges": True}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "cell.rests.json"


@pytest.fixture
def cell() -> Configuration:
    return setting_of("ur_offset").configuration


def watch_of(program: Program) -> SlipWatch:
    return SlipWatch(program.model, SLICES, 0.003)


def until_written(kept: KeptRests) -> None:
    if kept._writing is not None:
        kept._writing.join()


def a_run(path: Path, cell: Configuration, watch: SlipWatch, *events: dict[str, Any]) -> str:
    """Have a run of the daemon begin with the file and end with what ``watch`` holds then."""
    kept = KeptRests(SYSTEM)
    detail = kept.open(path, watch, cell)
    for event in events:
        kept.on_event(event)
    assert kept.step(watch, cell, at_once=True) == ""
    until_written(kept)
    return detail


@pytest.fixture
def learned(path: Path, cell: Configuration) -> Program:
    """Return a program whose rests an earlier run has kept."""
    program = Program(SETUPS[0], 21)
    watch, kept = watch_of(program), KeptRests(SYSTEM)
    assert kept.open(path, watch, cell) == ""
    assert found_in(watch, program, LEARNING)[:2] == ([], [])
    kept.step(watch, cell, at_once=True)
    until_written(kept)
    return program


def test_a_slip_while_the_link_is_lost_is_found_after_it() -> None:
    program = Program(SETUPS[0], 20)
    watch = watch_of(program)
    found_in(watch, program, LEARNING)
    watch.interrupt()
    program.slip(3, 0.010)
    (slip,), forces, _ = found_in(watch, program, ROUNDS)
    assert 4 in slip["joints"]
    assert forces == []


def test_a_slip_between_two_runs_is_found_in_the_second(
    learned: Program, path: Path, cell: Configuration
) -> None:
    watch = watch_of(learned)
    assert KeptRests(SYSTEM).open(path, watch, cell) == ""
    assert watch.learned
    learned.slip(4, 0.010)
    learned.time = 0.0  # the controller was off, too
    (slip,), _, _ = found_in(watch, learned, ROUNDS)
    assert 5 in slip["joints"]


def test_a_night_without_a_slip_is_none(learned: Program, path: Path, cell: Configuration) -> None:
    watch = watch_of(learned)
    KeptRests(SYSTEM).open(path, watch, cell)
    learned._drift += np.repeat((3.0, 0.1, 4.0), (3, 3, 6))  # N, Nm, Nm: zeros, over a night
    learned.time = 0.0
    assert found_in(watch, learned, 4 * COUNTS)[:2] == ([], [])


def test_what_is_kept_equals_what_was_learned(
    learned: Program, path: Path, cell: Configuration
) -> None:
    before = path.read_text()
    watch = watch_of(learned)
    assert a_run(path, cell, watch) == ""
    assert path.read_text() == before
    assert len(watch.rests) == LEARNING - 1  # the last one had not ended
    assert len(before) < 30_000


@pytest.mark.parametrize("change", ["text", "file"])
def test_a_changed_cell_or_file_of_it_forgets_what_was_learned(
    learned: Program, path: Path, cell: Configuration, change: str
) -> None:
    files = {**cell.files, "/robot.urdf": b"another"}
    other = replace(cell, text=cell.text + "\n") if change == "text" else replace(cell, files=files)
    watch = watch_of(learned)
    detail = a_run(path, other, watch)
    assert "found rests with another cell; joints' zeros are learned anew" in detail
    assert watch.rests == ()
    assert a_run(path, other, watch_of(learned)) == ""  # reported once


def test_another_version_of_the_program_learns_anew(
    learned: Program, path: Path, cell: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kept_rests, "installed_version", lambda: "99.0")
    watch = watch_of(learned)
    assert "learned anew" in a_run(path, cell, watch)
    assert watch.rests == ()


def spoiled(change: Callable[[dict[str, Any]], object]) -> Callable[[bytes], bytes]:
    def spoil(data: bytes) -> bytes:
        document = json.loads(data)
        change(document)
        return json.dumps(document).encode()

    return spoil


@pytest.mark.parametrize(
    "spoil",
    [
        lambda data: b"",
        lambda data: data[:-20],
        lambda data: b"\xff\xfe",
        lambda data: b"[]",
        lambda data: b"[" * 100_000,
        spoiled(lambda d: d.update(schema="gapbridge.rests/2")),
        spoiled(lambda d: d.pop("of")),
        spoiled(lambda d: d.update(slip=3)),
        spoiled(lambda d: d.update(slip={})),
        spoiled(lambda d: d.update(poses=None)),
        spoiled(lambda d: d.update(poses=d["poses"] * 20)),
        spoiled(lambda d: d["poses"][0].update(q=[0.0])),
        spoiled(lambda d: d["poses"][0].update(q=["x"] * 6)),
        spoiled(lambda d: d["poses"][0].update(mass=float("nan"))),
        spoiled(lambda d: d["poses"][0].update(cog=[1e300] * 3)),
        spoiled(lambda d: d.update(rests=d["rests"] * 9)),
        spoiled(lambda d: d["rests"][0].pop()),
        spoiled(lambda d: d["rests"].append([99, 0.0, [0.0] * 12])),
        spoiled(lambda d: d["rests"].append([float("inf"), 0.0, [0.0] * 12])),
        spoiled(lambda d: d["rests"].append([0, 0.0, [0.0] * 11])),
    ],
)
def test_a_file_of_garbage_is_ignored_with_one_line(
    learned: Program, path: Path, cell: Configuration, spoil: Callable[[bytes], bytes]
) -> None:
    path.write_bytes(spoil(path.read_bytes()))
    watch = watch_of(learned)
    detail = a_run(path, cell, watch)
    assert detail == f"{path}: found no rests of an arm, ignored; joints' zeros are learned anew"
    assert watch.rests == ()
    assert found_in(watch, learned, COUNTS)[:2] == ([], [])


def test_a_slip_is_kept_until_it_is_acknowledged_whatever_the_cell(
    path: Path, cell: Configuration
) -> None:
    program = Program(SETUPS[0], 22)
    a_run(path, cell, watch_of(program), FOUND)
    other = replace(cell, text=cell.text + "\n")
    for _ in range(2):
        kept = KeptRests(SYSTEM)
        kept.open(path, watch_of(program), other)
        assert kept.slip_of_earlier_run() == FOUND
        assert kept.slip_of_earlier_run() is None
        a_run(path, other, watch_of(program))
    a_run(path, other, watch_of(program), ACKNOWLEDGED)
    kept = KeptRests(SYSTEM)
    kept.open(path, watch_of(program), other)
    assert kept.slip_of_earlier_run() is None


def test_the_file_is_written_once_a_minute_and_only_if_something_is_new(
    path: Path, cell: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(1)
    clock = SimulatedClock(world)
    program = Program(SETUPS[0], 23)
    watch, kept = watch_of(program), KeptRests(clock)
    kept.open(path, watch, cell)
    written: list[float] = []
    monkeypatch.setattr(kept_rests._Write, "start", lambda _: written.append(world.now))
    kept._problem = lambda: ""  # type: ignore[method-assign]
    for number in range(LEARNING + 3):
        found_in(watch, program, 1)
        world.run(world.now + 5.0)
        kept.step(watch, cell)
        assert watch.learned or not written, number
    begun = world.now
    for _ in range(3):  # nothing new
        world.run(world.now + EVERY)
        kept.step(watch, cell)
    assert written
    assert min(np.diff([0.0, *written])) >= EVERY
    assert len([at for at in written if at > begun]) == 1


def test_a_disk_that_cannot_be_written_is_told_once(
    learned: Program, tmp_path: Path, cell: Configuration
) -> None:
    watch, kept = watch_of(learned), KeptRests(SYSTEM, longest_wait=30.0)
    kept.open(tmp_path / "none" / "x.json", watch, cell)
    kept.on_event(FOUND)
    detail = []
    for _ in range(3):
        detail.append(kept.step(watch, cell, at_once=True))
        detail.append(kept.finish())
    detail.append(kept.step(watch, cell))
    (line,) = [line for line in detail if line]
    assert "is lost at the end" in line
    assert "cannot be written" in line


def test_a_disk_that_does_not_answer_keeps_no_daemon_from_its_end(
    path: Path, cell: Configuration, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers, texts, slow = threading.Event(), iter("abcd"), list[str]()

    def hangs(_: Path, text: str) -> None:
        slow.append(text)
        answers.wait(30.0)

    kept = KeptRests(SYSTEM, longest_wait=0.01)
    kept._path = path
    with monkeypatch.context() as patched:
        patched.setattr(kept_rests, "write_text", hangs)
        patched.setattr(kept, "_document", lambda *_: next(texts))
        for _ in range(3):  # nothing waits behind a write that hangs
            assert kept.step(None, None, at_once=True) == ""  # type: ignore[arg-type]
        assert f"{path}: the file system does not answer" in kept.finish()
        assert kept.finish() == ""  # reported once
        assert kept._writing is not None
        assert kept._writing.daemon  # the interpreter does not wait for it either
        answers.set()
        kept._writing.join()
        kept.step(None, None)  # type: ignore[arg-type]
        kept._writing.join()
    assert slow == ["a", "b"]


def test_a_loop_that_dies_leaves_the_watch_as_it_is_and_a_changed_cell_does_not() -> None:
    with rides_on_a_program() as (run, world):
        daemon = run.daemon
        before = daemon._zeros.slips
        run.loops[-1].kill()
        until(world, lambda: len(run.loops) > 1 and daemon.state == State.OBSERVING, 10.0)
        assert daemon._zeros.slips is before
        cell = daemon.configuration
        daemon._take_configuration(replace(cell, text=cell.text + "\n"))
        assert daemon._zeros.slips is not before


def test_a_slip_that_nobody_has_acknowledged_holds_the_next_run_of_the_daemon(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with rides_on_a_program() as (run, world):
        daemon, begun = run.daemon, world.now
        daemon._zeros.open()
        daemon._zeros.slips.take = lambda rows: [FOUND] if world.now < begun + 0.02 else []  # type: ignore[method-assign]
        until(world, lambda: daemon.state == State.OBSERVING, 3.0)
        until_written(daemon._zeros.kept)
    assert [p.parent.name for p in tmp_path.rglob("*.rests.json")] == ["gapbridge"]
    for acknowledge in (True, False):
        with rides_on_a_program(arm=False) as (run, world):
            daemon = run.daemon
            daemon._zeros.open()
            if acknowledge:
                until(world, lambda d=daemon: d.latched == FOUND["detail"], 3.0)  # type: ignore[misc]
                until(world, lambda d=daemon: d.status()["counts"]["zero_moved"] == 1, 3.0)  # type: ignore[misc]
                assert daemon.state == State.OBSERVING
                assert FOUND["detail"] in ask(run, "arm")["error"]
                assert ask(run, "disarm")["ok"]
            assert ask(run, "arm")["answer"] == "compensating"
            until_written(daemon._zeros.kept)


def test_the_state_folder_is_the_service_managers_or_the_users_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "a"))
    assert state_folder() == tmp_path / "a" / "gapbridge"
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path / 'b'}:/other")
    assert state_folder() == tmp_path / "b"
    (tmp_path / "c").touch()
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "c"))
    with pytest.raises(InputError, match="expected"):
        state_folder()
