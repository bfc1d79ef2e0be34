"""A failed verification and the daemon: it holds and does not arm until a person has seen it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from simulated_daemon import ask, causes, rides_on_a_program, until

from benchmarks.simulation.links import setting_of
from benchmarks.simulation.processes import Run as SimulatedRun
from benchmarks.simulation.processes import SimulatedDaemon
from gapbridge.bridge.cell.verification_mark import mark_path, remove_mark, write_mark
from gapbridge.bridge.daemon import verification_watch
from gapbridge.bridge.daemon.verification_watch import VerificationWatch
from gapbridge.bridge.ipc.command_memory import Command
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.core.errors import RunError

REASON = "the zero of joint 5 moved by 10 mrad"


@pytest.fixture
def cell() -> Iterator[Path]:
    path = setting_of("ur_offset").configuration.settings.cell
    yield path
    if mark_path(path).is_dir():
        mark_path(path).rmdir()
    remove_mark(path)


def counted(run: SimulatedRun) -> int:
    return int(run.daemon.status()["counts"]["zero_moved"])  # /metrics: gapbridge_incidents


def verifications(run: SimulatedRun) -> list[bool]:
    return [e["holds"] for e in run.daemon.event_log.recent if e["kind"] == "verification"]


def test_a_marked_cell_is_not_armed_until_a_person_has_acknowledged_it(cell: Path) -> None:
    write_mark(cell, REASON, cell.parent)
    with rides_on_a_program(arm=False) as (run, world):
        daemon = run.daemon
        until(world, lambda: counted(run) == 1, 3.0)
        assert daemon.state == State.OBSERVING
        assert verifications(run) == [False]
        refused = ask(run, "arm")
        assert not refused["ok"]
        assert REASON in refused["error"]
        assert "gapbridge disarm" in refused["error"]
        daemon.arm()  # past the answer
        until(world, lambda: daemon.event_log.counts["refused"] == 1, 3.0)
        daemon._commands.ask(Command.ARM)  # past the daemon
        until(world, lambda: daemon.event_log.counts["refused"] == 2, 3.0)
        assert daemon.state == State.OBSERVING
        assert ask(run, "disarm")["ok"]
        assert not mark_path(cell).exists()
        assert daemon.latched == ""
        assert ask(run, "arm")["answer"] == "compensating"
        assert counted(run) == 1


def test_a_cell_that_arms_by_itself_does_not_with_a_mark(cell: Path) -> None:
    write_mark(cell, REASON, cell.parent)
    with rides_on_a_program(arm=False) as (run, _):
        run.daemon._start_loop("the cell file", since=0).kill()
        assert run.daemon._commands.last_of(Command.ARM) == 0
        (event,) = [e for e in run.daemon.event_log.recent if e["kind"] == "refused"]
        assert REASON in event["detail"]


def test_a_verification_that_fails_in_a_run_holds_it_and_one_that_passes_frees_it(
    cell: Path,
) -> None:
    with rides_on_a_program() as (run, world):
        write_mark(cell, REASON, cell.parent)
        until(world, lambda: run.daemon.state == State.OBSERVING, 4.0)
        assert causes(run)[-2:] == ["zero moved", "ramped out"]
        assert counted(run) == 1
        assert not ask(run, "arm")["ok"]
        remove_mark(cell)
        until(world, lambda: run.daemon.latched == "", 2.0)
        assert verifications(run) == [False, True]
        assert run.daemon.state == State.OBSERVING  # only a person arms
        assert ask(run, "arm")["answer"] == "compensating"


def test_a_mark_outlives_a_loop_that_dies_and_is_counted_once(cell: Path) -> None:
    with rides_on_a_program() as (run, world):
        write_mark(cell, REASON, cell.parent)
        until(world, lambda: counted(run) == 1, 4.0)
        run.loops[-1].kill()
        until(world, lambda: len(run.loops) > 1 and run.daemon.state == State.FAULT, 10.0)
        assert not ask(run, "arm")["ok"]
        remove_mark(cell)
        until(world, lambda: run.daemon.state == State.OBSERVING, 3.0)
        assert counted(run) == 1
        assert ask(run, "arm")["answer"] == "compensating"


def test_a_mark_found_between_two_loops_is_counted_by_the_next(cell: Path) -> None:
    with rides_on_a_program() as (run, world):
        run.loops[-1].kill()
        until(world, lambda: run.daemon.loop is None, 3.0)
        write_mark(cell, REASON, cell.parent)
        run.daemon._zeros.check()
        assert counted(run) == 0
        until(world, lambda: counted(run) == 1, 10.0)
        assert not ask(run, "arm")["ok"]


@pytest.mark.parametrize("data", [b"", b"{}", b"\xff\xfe"], ids=repr)
def test_a_mark_of_garbage_refuses_in_one_line_and_can_be_acknowledged(
    cell: Path, data: bytes
) -> None:
    mark_path(cell).write_bytes(data)
    with rides_on_a_program(arm=False) as (run, world):
        until(world, lambda: counted(run) == 1, 3.0)
        refused = ask(run, "arm")
        assert "found no mark that can be read" in refused["error"]
        assert "\n" not in refused["error"]
        assert ask(run, "disarm")["ok"]
        assert ask(run, "arm")["answer"] == "compensating"


def test_a_mark_that_cannot_be_removed_stays_latched_and_says_why(cell: Path) -> None:
    mark_path(cell).mkdir()
    with rides_on_a_program(arm=False) as (run, world):
        until(world, lambda: counted(run) == 1, 3.0)
        reply = ask(run, "disarm")
        assert not reply["ok"]
        assert f"{mark_path(cell)}: cannot be removed" in reply["error"]
        assert not ask(run, "arm")["ok"]
        mark_path(cell).rmdir()
        until(world, lambda: run.daemon.latched == "", 2.0)
        assert ask(run, "arm")["answer"] == "compensating"


def test_a_newer_mark_is_not_removed_unseen(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.touch()
    watch = VerificationWatch(path)
    write_mark(path, "the tool moved", tmp_path)
    assert watch.look() is not None
    write_mark(path, REASON, tmp_path)
    watch.acknowledge()
    event = watch.look()
    assert event is not None
    assert REASON in event["detail"]
    watch.acknowledge()
    assert watch.look() == {
        "kind": "verification", "holds": True,
        "detail": f"acknowledged or verified again: {event['detail']}",
    }  # fmt: skip


def test_a_folder_that_is_away_passes_no_verification(tmp_path: Path) -> None:
    path = tmp_path / "share" / "cell.yaml"
    path.parent.mkdir()
    path.touch()
    watch = VerificationWatch(path)
    write_mark(path, REASON, tmp_path)
    assert watch.look() is not None
    path.parent.rename(tmp_path / "away")
    assert watch.look() is None


def test_why_a_mark_is_still_there_is_told_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "cell.yaml"
    path.touch()
    watch = VerificationWatch(path)
    write_mark(path, REASON, tmp_path)
    watch.look()

    def refuse(_: Path) -> bool:
        raise RunError("a read-only file system")

    with monkeypatch.context() as patched:
        patched.setattr(verification_watch, "remove_mark", refuse)
        watch.acknowledge()
    assert watch.problem == "a read-only file system"
    watch.acknowledge()
    assert watch.problem == ""


def test_a_folder_that_does_not_answer_keeps_no_disarm_waiting_and_nothing_is_armed(
    cell: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = threading.Event()
    answers.set()

    def hangs(_: Path) -> str:
        answers.wait(10.0)
        return ""

    monkeypatch.setattr(verification_watch, "read_mark", hangs)
    monkeypatch.setattr(SimulatedDaemon, "longest_wait", 1.0)  # waited for once
    with rides_on_a_program() as (run, world):
        until(world, lambda: run.daemon.state == State.COMPENSATING, 3.0)
        answers.clear()
        until(world, lambda: "does not answer" in run.daemon._zeros.verification.blocked, 2.0)
        assert run.daemon.state == State.COMPENSATING
        assert ask(run, "disarm")["answer"] == "observing"
        reply = ask(run, "arm")
        assert f"{mark_path(cell).parent}: the file system does not answer" in reply["error"]
        answers.set()
        call = run.daemon._zeros.verification._call
        assert call is not None
        call.join()
        until(world, lambda: not run.daemon._zeros.verification.blocked, 3.0)
        assert ask(run, "arm")["answer"] == "compensating"


def test_a_session_that_moves_the_arm_without_corrections_watches_no_mark() -> None:
    assert VerificationWatch(None).look() is None
