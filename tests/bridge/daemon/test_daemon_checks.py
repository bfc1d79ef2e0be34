"""The checks of every cycle on the real wire: what is found, what follows, what stays."""

from __future__ import annotations

import os
import signal
import socket
from pathlib import Path

import numpy as np
import pytest
from daemon_cell import Robot, Run, offsets
from patience import PATIENCE, wait_for

from gapbridge.bridge.daemon.status_document import lines
from gapbridge.bridge.ipc.loop_state import State

pytestmark = pytest.mark.usefixtures("runtime")

PATIENT = ", state_timeout: 0.2"


@pytest.mark.slow
def test_an_offset_that_stands_at_its_limit_ends_the_compensation(robot: Robot) -> None:
    cell = robot.cell(PATIENT, limits="{offset: 0.0002}")
    with Run(cell, arm=True) as run:
        run.compensate()

        def saturated() -> bool:
            if run.daemon.state == State.OBSERVING:
                run.daemon.arm()  # a busy machine was late, and the loop held before its second
            return "offset saturated" in " ".join(run.output)

        wait_for(saturated, "the saturation")
        run.wait(State.OBSERVING)
        assert run.daemon.status()["counts"]["saturated"] == 1
        run.end()
        moved = np.linalg.norm(offsets(run.cycles())[:, :3], axis=1)
    assert moved.max() <= 2e-4 * (1 + 1e-9)
    assert moved[-1] == 0.0


@pytest.mark.slow
@pytest.mark.realtime(limit=0.1)
def test_a_loop_that_was_suspended_begins_anew_and_observes(robot: Robot) -> None:
    with Run(robot.cell(PATIENT), arm=True) as run:
        run.compensate()
        run.write(60)
        pid = run.daemon.loop_pid
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)
        robot.elapse(0.4)
        os.kill(pid, signal.SIGCONT)
        wait_for(lambda: not run.daemon.state.writes, "no more writing")
        run.wait(State.OBSERVING)
        run.cycle(150)
        assert run.daemon.state == State.OBSERVING
        assert run.daemon.latched == ""
        run.end()
        cycles = run.cycles()
    moved, written = offsets(cycles)[:, :3], cycles["written"] > 0
    steps = np.linalg.norm(np.diff(moved, axis=0), axis=1)
    # the robot's own watchdog may have ended its program meanwhile: then nothing more is written
    assert steps[written[1:] & written[:-1]].max() <= 0.05 * 0.002 * 5.001


def refusal(run: Run) -> str:
    """Arm and return why that was refused."""
    before = len(run.output)
    run.daemon.arm()
    wait_for(lambda: len(run.output) > before, "a word on arming")
    run.cycle(100)
    assert not run.daemon.state.writes, run.output
    return " ".join(run.output[before:])


def changed(cell: Path, old: str, new: str) -> None:
    text = cell.read_text()
    assert old in text
    cell.write_text(text.replace(old, new))


def nothing_left(run: Run) -> None:
    assert run.end().exit_code == 1
    assert not run.cycles()["written"].any()


@pytest.mark.slow
@pytest.mark.parametrize("times", [1000.0, 0.0])
def test_a_model_that_is_no_use_is_reported_and_does_not_arm(robot: Robot, times: float) -> None:
    cell = robot.cell(PATIENT)
    axial, radial = (
        [times * value for value in values]
        for values in (robot.settings.plant.axial, robot.settings.plant.radial)
    )
    line = next(line for line in cell.read_text().split("\n") if line.startswith("compliance"))
    changed(cell, line, f"compliance: {{axial: {axial}, radial: {radial}}}")
    with Run(cell) as run:
        run.wait(State.OBSERVING)
        run.cycle(250)
        output = refusal(run)
        status = run.daemon.status()
        nothing_left(run)
    assert status["correction"]["solved"] == (times == 0.0)
    if times:
        assert "the correction cannot be solved at the present pose: " in output
        assert "no correction at the present pose" in "\n".join(lines(status))
    else:
        assert "the model corrects nothing at any pose" in output
        assert "the model corrects nothing" in "\n".join(lines(status))


def test_arming_warns_of_what_differs_from_the_controller_and_is_no_reason_to_refuse(
    robot: Robot,
) -> None:
    cell = robot.cell(PATIENT)
    changed(cell, "mass: 5.0", "mass: 4.5")
    with Run(cell, arm=True) as run:
        run.compensate()
        run.end()
    warned = [line for line in run.output if "payload.mass" in line]
    assert warned == ["payload.mass: found 4.5 kg, expected 5 kg, as the controller has it"]


@pytest.mark.slow
def test_the_age_of_the_last_state_is_shown_in_the_unit_of_its_size(robot: Robot) -> None:
    with Run(robot.cell(PATIENT)) as run:
        run.wait(State.OBSERVING)
        status = run.daemon.status()
        run.end()
    for age, text in ((0.0124, "12 ms"), (15.244, "15 s"), (300.0, "5 min"), (9e4, "25 h")):
        status["link"]["age"] = age
        assert f" Hz, last state {text} ago, cycles" in lines(status)[2]
    status["link"]["age"] = None
    assert " Hz, no state yet, cycles" in lines(status)[2]


def script(robot: Robot, line: str) -> None:
    """Have the controller run a line beside its program, as a person at the pendant would."""
    before = robot.controller.log().count("program person uploaded")
    with socket.create_connection(
        (robot.host, robot.settings.script_port), timeout=PATIENCE
    ) as upload:
        upload.sendall(f"sec person():\n  {line}\nend\n".encode())
        wait_for(
            lambda: robot.controller.log().count("program person uploaded") > before, "the line"
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "cause"),
    [
        ("set_payload(40.0, [0.0, 0.0, 0.06])", "(load implausible): payload: found 40 kg"),
        ("set_payload(400.0, [0.0, 0.0, 0.06])", "(load implausible): payload: found 400 kg"),
        ("set_tcp(p[0.0, 0.05, 0.18, 0.0, 0.0, 0.0])", "the controller's TCP is 50.0 mm"),
        ("set_tcp(p[0.0, 0.0, 0.18, 0.0, 0.1, 0.0])", "0.0 mm and 0.100 rad from the cell's"),
    ],
)
def test_what_a_person_changes_in_the_controller_during_a_run_is_held_and_not_corrected_for(
    robot: Robot, line: str, cause: str
) -> None:
    program = robot.start_offset_program()
    with Run(robot.cell(f"{PATIENT}, mode: offset"), arm=True) as run:
        run.compensate()
        run.write(60)
        script(robot, line)
        wait_for(lambda: cause in " ".join(run.output), lambda: f"{cause} ({run.output})")
        run.wait(State.OBSERVING)
        assert cause.split(": ")[-1] in refusal(run)
        run.end()
        cycles = run.cycles()
    program.close()
    before = np.array(cycles["state"]) == "compensating"
    moved = np.linalg.norm(offsets(cycles)[:, :3], axis=1)
    # the offset that was there went out; none was made of the change
    assert moved.max() <= moved[before].max() * 1.01 + 1e-6
    assert moved.max() < 1e-3
    assert moved[-1] == 0.0


@pytest.mark.slow
def test_a_rate_above_the_controllers_is_refused_by_name(robot: Robot) -> None:
    with Run(robot.cell(", rate: 1000"), arm=True) as run:
        wait_for(lambda: any("link.rate" in line for line in run.output), "a refusal")
        output = " ".join(run.output)
        nothing_left(run)
    assert "link.rate: found 1000 Hz, expected at most 500 Hz" in output


@pytest.mark.slow
def test_a_hiccup_while_observing_leaves_no_fault_and_arming_works(robot: Robot) -> None:
    with Run(robot.cell()) as run:
        run.wait(State.OBSERVING)
        run.cycle(250)
        robot.bench("stall 0.5")
        wait_for(lambda: run.daemon.status()["counts"]["silence"] == 1, "silence")
        run.wait(State.OBSERVING)
        run.cycle(250)
        assert run.daemon.latched == ""
        assert run.daemon.state == State.OBSERVING, run.output
        assert run.daemon.status()["counts"]["silence"] == 1
        run.compensate()
        run.end()
