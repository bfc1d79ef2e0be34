"""A changed cell file is taken whole or not at all, and never with a jump."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from daemon_cell import Robot, Run, offsets
from patience import wait_for

from gapbridge.bridge.cell.run_settings import Configuration, read_configuration
from gapbridge.bridge.daemon import reload
from gapbridge.bridge.daemon.reload import Reload
from gapbridge.bridge.daemon.service_manager import ServiceManager
from gapbridge.bridge.ipc.events import EventKind, EventLog
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import Phase
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.drivers.clock import SYSTEM

pytestmark = pytest.mark.usefixtures("runtime")

CELL = """robot: {model: ur10e}
link: {driver: ur_rtde, host: 192.0.2.7}
setpoints: {arm: true}
"""


class Taking:
    """A reload of a cell that arms by itself, asked for while the arm compensates."""

    def __init__(self, folder: Path, in_thread: bool = False) -> None:
        cell = folder / "cell.yaml"
        cell.write_text(CELL)
        self.running = read_configuration(cell)
        self.reload = Reload(ServiceManager(clock=SYSTEM), EventLog(clock=SYSTEM), in_thread)
        self.request("arm")
        self.reload.ask()

    def step(self, state: State) -> bool:
        return self.reload.step(state, Phase.RUNNING, self.running)

    def request(self, command: str) -> None:
        self.reload.on_event({"kind": EventKind.REQUEST, "command": command})

    def transition(self, cause: Cause, before: State = State.HOLDING) -> None:
        self.reload.on_event({"kind": EventKind.TRANSITION, "from": before.name, "cause": cause})


def test_a_folder_that_does_not_answer_keeps_the_daemon_not_waiting(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taking, answers, readings = Taking(tmp_path, in_thread=True), threading.Event(), list[str]()

    def hangs(_: Path) -> Configuration:
        readings.append(threading.current_thread().name)
        answers.wait(10.0)
        return taking.running

    monkeypatch.setattr(reload, "read_configuration", hangs)
    for _ in range(3):
        assert not taking.step(State.COMPENSATING)  # it is still read
        taking.reload.ask()  # and is to be read again
    reading = taking.reload._reading
    assert reading is not None
    answers.set()
    reading.join()
    assert taking.step(State.COMPENSATING)
    assert taking.step(State.COMPENSATING)
    again = taking.reload._reading
    if again is not None:  # it may have been as fast
        again.join()
    taking.step(State.HOLDING)
    assert readings == ["reload"] * 2


def test_without_a_thread_the_files_are_read_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    taking = Taking(tmp_path, in_thread=True)
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", refuses)
        assert not taking.step(State.COMPENSATING)
    taking.step(State.COMPENSATING)
    if (reading := taking.reload._reading) is not None:
        reading.join()
    assert taking.step(State.COMPENSATING)


@pytest.mark.parametrize("connects", [False, True])
def test_a_reload_arms_again_what_it_has_ramped_out(connects: bool, tmp_path: Path) -> None:
    taking = Taking(tmp_path)
    if connects:  # a cell that arms by itself requests it before its link is there
        taking.transition(Cause.CONNECTED, State.DISCONNECTED)
    assert taking.step(State.COMPENSATING)
    taking.transition(Cause.DISARM)
    assert not taking.step(State.HOLDING)
    taking.transition(Cause.RAMPED_OUT)
    assert not taking.step(State.OBSERVING)
    assert taking.reload.wants_end
    swap = taking.reload.swap()
    assert (swap.rearms, swap.in_order) == (True, True)


@pytest.mark.parametrize("later", [State.HOLDING, State.OBSERVING])
def test_a_second_reload_before_the_first_is_done_arms_again_too(
    later: State, tmp_path: Path
) -> None:
    taking = Taking(tmp_path)
    assert taking.step(State.COMPENSATING)
    taking.transition(Cause.DISARM)
    taking.reload.ask()
    taking.step(later)
    taking.transition(Cause.RAMPED_OUT)
    taking.step(State.OBSERVING)
    assert taking.reload.swap().rearms
    taking.reload.ask()
    taking.step(State.OBSERVING)
    assert not taking.reload.swap().rearms  # a later one has found an arm that observes


@pytest.mark.parametrize("cause", [Cause.LINK_LOST, Cause.WRITE_FAILED, Cause.FOREIGN])
def test_a_reload_does_not_arm_what_a_fault_has_ended(cause: Cause, tmp_path: Path) -> None:
    taking = Taking(tmp_path)
    assert taking.step(State.COMPENSATING)
    taking.transition(Cause.DISARM)
    taking.step(State.HOLDING)
    taking.transition(cause)
    taking.step(State.DISCONNECTED if cause == Cause.LINK_LOST else State.OBSERVING)
    assert not taking.reload.swap().rearms


@pytest.mark.parametrize("state", [State.DISCONNECTED, State.FAULT])
def test_a_reload_does_not_arm_what_has_died_without_a_word(state: State, tmp_path: Path) -> None:
    taking = Taking(tmp_path)
    taking.step(State.COMPENSATING)
    taking.step(state)
    assert taking.reload.wants_end
    assert not taking.reload.swap().rearms


@pytest.mark.parametrize("early", [False, True])
def test_a_person_who_disarms_while_a_reload_ramps_out_is_obeyed(
    early: bool, tmp_path: Path
) -> None:
    taking = Taking(tmp_path)
    if early:  # the loop has not taken it yet
        taking.request("disarm")
    taking.step(State.COMPENSATING)
    if not early:
        taking.request("disarm")
    taking.transition(Cause.DISARM)
    taking.transition(Cause.RAMPED_OUT)
    taking.step(State.OBSERVING)
    assert not taking.reload.swap().rearms


def test_sections_of_running_processes_stay_and_each_reload_names_them(tmp_path: Path) -> None:
    taking = Taking(tmp_path)
    cell, running = taking.running.settings.cell, taking.running
    for folder, port in ("elsewhere", 9101), ("third", 9102):
        cell.write_text(
            f"{CELL}recording: {{folder: {folder}}}\nmetrics: {{port: {port}}}\n"
            "limits: {offset: 0.003}\n"
        )
        taking.reload.ask()
        taking.step(State.OBSERVING)
        (*_, event) = taking.reload._event_log.recent
        assert event["ok"]
        assert event["detail"].endswith("recording, metrics: at the daemon's next start")
        new = taking.reload.swap().configuration
        assert new is not None
        assert new.settings.recording == running.settings.recording
        assert new.settings.metrics is None
        assert new.settings.limits.offset == 0.003
        taking.running = new


def test_an_unchanged_cell_that_was_given_by_a_relative_path_has_no_changed_section(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    taking = Taking(Path())
    taking.reload.ask()
    taking.step(State.OBSERVING)
    (*_, event) = taking.reload._event_log.recent
    assert event["detail"] == "the cell file was read again and is being taken"


PATIENT = ", state_timeout: 0.25"


def configured(run: Run) -> dict[str, Any]:
    """Return the event of the last attempt."""
    wait_for(lambda: bool(run.daemon.status()["configured"]), "the cell read again")
    found: dict[str, Any] = run.daemon.status()["configured"]
    return found


@pytest.mark.slow
def test_a_wrong_cell_changes_nothing_and_everything_wrong_is_reported(robot: Robot) -> None:
    cell = robot.cell(PATIENT)
    with Run(cell, arm=True) as run:
        run.compensate()
        pid, before = run.daemon.loop_pid, run.daemon.status()["configuration_hash"]
        text = cell.read_text().replace("mass: 5.0", "mass: heavy") + "limits: {offset: -1}\n"
        cell.write_text(text + "recoding: {}\n")
        run.daemon.reload()
        event = configured(run)
        assert not event["ok"]
        for part in ("payload.mass: found 'heavy'", "limits.offset: found -1", "recoding"):
            assert part in event["detail"]
        run.cycle(150)
        assert run.daemon.state == State.COMPENSATING
        assert run.daemon.loop_pid == pid
        assert run.daemon.status()["configuration_hash"] == before
        assert run.end().restarts == 0


@pytest.mark.slow
def test_another_robot_or_another_arm_needs_a_new_start(robot: Robot) -> None:
    cell = robot.cell(PATIENT)
    with Run(cell) as run:
        run.wait(State.OBSERVING)
        cell.write_text(cell.read_text().replace(robot.host, "192.0.2.1"))
        run.daemon.reload()
        event = configured(run)
        assert not event["ok"]
        assert "192.0.2.1" in event["detail"]
        assert run.daemon.settings.link.host == robot.host  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.parametrize("arms", [False, True])
def test_a_changed_cell_is_ramped_out_of_and_into(robot: Robot, arms: bool) -> None:
    section = "{arm: true}" if arms else "{arm: false}"
    cell = robot.cell(PATIENT, setpoints=section)
    with Run(cell, arm=True) as run:
        run.compensate()
        run.write(60)
        first, before = run.daemon.loop_pid, run.daemon.status()["configuration_hash"]
        cell.write_text(cell.read_text() + "limits: {offset_rate: 0.02}\n")
        run.daemon.reload()
        assert configured(run)["ok"]
        wait_for(lambda: run.daemon.loop_pid not in (None, first), "the new loop")
        run.wait(State.COMPENSATING if arms else State.OBSERVING)
        run.cycle(500)
        assert run.daemon.state == (State.COMPENSATING if arms else State.OBSERVING)
        assert run.daemon.status()["configuration_hash"] != before
        summary = run.end()
        cycles = run.cycles()
    assert summary.restarts == 0
    assert not [line for line in run.output if "state stale" in line]
    moved = np.linalg.norm(offsets(cycles)[:, :3], axis=1)
    assert moved.max() > 4e-4
    assert np.abs(np.diff(moved)).max() <= 0.05 * 0.002 * 5.001
    second = np.array(cycles["loop"]) > 0
    assert np.abs(np.diff(moved[second])).max() <= 0.02 * 0.002 * 5.001
    assert (moved[second].max() > 4e-4) == arms


@pytest.mark.slow
def test_a_reload_while_observing_takes_effect_at_once(robot: Robot) -> None:
    cell = robot.cell(PATIENT)
    with Run(cell) as run:
        run.wait(State.OBSERVING)
        first = run.daemon.loop_pid
        cell.write_text(cell.read_text().replace("mass: 5.0", "mass: 4.0"))
        run.daemon.reload()
        assert configured(run)["ok"]
        wait_for(lambda: run.daemon.loop_pid not in (None, first), "the new loop")
        run.wait(State.OBSERVING)
        assert run.end().setpoints_written == 0
