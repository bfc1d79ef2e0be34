"""The daemon on the real wire: what it writes, when, and how the arm takes it."""

from __future__ import annotations

import json
import socket
import time
from pathlib import Path

import numpy as np
import pytest
from daemon_cell import Robot, Run, offsets
from patience import PATIENCE, wait_for
from recorded_documents import read_documents

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.bridge.recording.export import export
from gapbridge.core.log.log import read_log
from gapbridge.core.log.mcap_reading import read_configuration


def wanted_position(robot: Robot, cell: Path) -> np.ndarray:
    model = load_cell(cell).model
    return model.rigid_pose(np.array([robot.settings.start_q])).position[0]


@pytest.mark.slow
def test_observing_computes_and_records_and_writes_nothing(robot: Robot) -> None:
    before = robot.truth()
    with Run(robot.cell(), observe=True, duration=1.0) as run:
        summary = run.join()
    after = robot.truth()
    assert summary.exit_code == 0
    assert summary.setpoints_written == 0
    assert summary.cycles > 400
    assert after["true_tcp"] == before["true_tcp"]
    assert after["largest_servo_step"] == 0.0
    assert "program" not in robot.controller.log()
    cycles = run.cycles()
    assert set(cycles["state"]) == {"observing"}
    assert np.abs(cycles["corrected_q_1"] - cycles["nominal_q_1"]).max() > 1e-5


@pytest.mark.slow
def test_an_observer_cannot_be_armed(robot: Robot) -> None:
    with Run(robot.cell(), observe=True) as run:
        run.wait(State.OBSERVING)
        run.daemon.arm()
        run.cycle(150)
        assert run.daemon.state == State.OBSERVING
    assert "program" not in robot.controller.log()


def test_compensation_brings_the_tcp_to_where_it_was_wanted_without_a_jump(robot: Robot) -> None:
    cell = robot.cell()
    wanted = wanted_position(robot, cell)
    without = np.linalg.norm(robot.tcp() - wanted)
    with Run(cell, arm=True) as run:
        run.compensate()
        run.write(500)  # the ramp is over
        with_compensation = settled_error(robot, wanted)
        summary = run.end()
    assert without > 4e-4
    assert with_compensation < 1e-4
    assert with_compensation < without / 8
    assert summary.exit_code == 0
    assert summary.setpoints_written > 500
    cycles = run.cycles()
    moved, meant = offsets(cycles), cycles["attempted"] > 0
    steps = np.linalg.norm(np.diff(moved[:, :3], axis=0), axis=1)
    steps = steps[meant[1:] & meant[:-1]]  # a busy machine may end the writing in between
    assert steps.max() <= 0.05 * 0.002 * 5.001  # the offset's rate; a cycle may be missed
    assert np.median(np.linalg.norm(moved[meant, :3], axis=1)) > 4e-4
    assert np.linalg.norm(moved[-1]) == 0.0
    # what the ramp and the rates leave of a correction of a milliradian
    assert robot.truth()["largest_servo_step"] < 1e-4


@pytest.mark.slow
def test_after_a_run_the_arm_is_where_it_was_and_no_program_is_left(robot: Robot) -> None:
    with Run(robot.cell(), arm=True) as run:
        run.compensate()
        run.write(300)
        run.end()
    truth = robot.truth()
    rigid = load_cell(robot.cell()).model.rigid_pose(np.array([robot.settings.start_q]))
    assert truth["rigid_tcp"][:3] == pytest.approx(rigid.position[0], abs=2e-5)
    assert robot.controller.log().strip().endswith("program rtde_control ended")


@pytest.mark.slow
def test_a_person_arms_and_disarms_while_it_runs(robot: Robot) -> None:
    with Run(robot.cell()) as run:
        run.wait(State.OBSERVING)
        run.compensate()
        run.write(60)
        run.daemon.disarm()
        run.wait(State.OBSERVING)
        run.compensate()
        summary = run.end()
    assert summary.exit_code == 0
    assert summary.state == "observing"


@pytest.mark.slow
def test_a_robot_program_is_not_ended_to_arm(robot: Robot) -> None:
    with socket.create_connection((robot.host, 30003), timeout=PATIENCE) as upload:
        robot.upload(upload, "def own_work():\n  sleep(30)\nend\n")
        with Run(robot.cell(), arm=True, duration=0.5) as run:
            summary = run.join()
    assert summary.setpoints_written == 0
    assert summary.exit_code == 1
    assert any("found a program running" in line for line in summary.faults)
    assert "own_work ended" not in robot.controller.log()


@pytest.mark.slow
def test_a_recording_is_exported_as_a_log_and_has_the_events(robot: Robot) -> None:
    cell = robot.cell()
    with Run(cell, arm=True, duration=1.0) as run:
        run.join()
    path = run.daemon.recording
    assert path is not None
    export(path, robot.folder / "log.csv")
    log = read_log(robot.folder / "log.csv", 6)
    assert log.require("actual_q").shape == (len(log), 6)
    assert log.require("payload")[0] == 5.0
    assert (np.diff(log.require("timestamp")) > 0.001).all()
    assert not log.has("actual_current_as_torque")  # the library does not deliver it
    reported = read_documents(path)
    assert [e["to"] for e in reported if "to" in e] == [
        "OBSERVING", "ARMED", "COMPENSATING", "HOLDING", "OBSERVING",
    ]  # fmt: skip
    (summary,) = [e["summary"] for e in reported if e["kind"] == "summary"]
    assert summary["setpoints_written"] > 100
    assert reported[-1]["kind"] == "ended"
    assert read_configuration(path)["text"] == cell.read_text(encoding="utf-8")


def settled_error(robot: Robot, wanted: np.ndarray, patience: float = 15.0) -> float:
    """Return how far the tracker sees the TCP from the wanted place once the ramp is over.

    A busy machine may starve the heartbeat, and the robot ramps out and in again.
    """
    end, error = time.monotonic() + patience, np.inf
    while time.monotonic() < end and error >= 1e-4:
        time.sleep(0.5)
        error = float(np.linalg.norm(robot.tcp() - wanted))
    return error


@pytest.mark.realtime(limit=0.03)  # later than that, stale states have ended the motion
def test_offset_mode_corrects_under_the_robots_own_program(robot: Robot) -> None:
    program = robot.start_offset_program()
    cell = robot.cell(link=", mode: offset")
    wanted = wanted_position(robot, cell)
    without = np.linalg.norm(robot.tcp() - wanted)
    with Run(cell, arm=True) as run:
        run.compensate()
        with_compensation = settled_error(robot, wanted)
        start = robot.settings.start_q
        robot.bench("move 0.2 " + " ".join(map(str, start[1:])))
        wait_for(lambda: abs(run.latest("nominal_q")[0] - 0.2) < 1e-7, "the end of the motion")
        summary = run.end()
    assert without > 4e-4
    assert with_compensation < 1e-4
    assert summary.exit_code == 0, run.output
    cycles = run.cycles()
    written = cycles["written"] > 0
    # the nominal is the robot's own motion, and the offset is not in it
    assert np.abs(cycles["nominal_q_1"] - start[1]).max() < 1e-6
    assert np.abs(cycles["target_q_1"] - start[1])[written].max() > 1e-4
    assert cycles["nominal_q_0"][-1] == pytest.approx(0.2, abs=1e-6)
    rigid = load_cell(cell).model.rigid_pose(np.array([(0.2, *start[1:])])).position[0]
    wait_for(
        lambda: np.abs(robot.truth()["rigid_tcp"][:3] - rigid).max() < 1e-6,
        lambda: f"the arm without offset ({robot.truth()})",
    )
    program.close()


@pytest.mark.slow
def test_offset_mode_needs_the_robots_program(robot: Robot) -> None:
    with Run(robot.cell(link=", mode: offset"), arm=True, duration=0.5) as run:
        summary = run.join()
    assert summary.exit_code == 1
    assert any("gapbridge_offset.script" in line for line in summary.faults)


def trajectory(path: Path, start: tuple[float, ...], way: float, seconds: float) -> None:
    lines = ["timestamp," + ",".join(f"target_q_{i}" for i in range(6))]
    for t in np.linspace(0.0, seconds, 51):
        share = 0.5 - 0.5 * np.cos(np.pi * t / seconds)
        q = [start[0] + way * share, *start[1:]]
        lines.append(",".join(f"{v:.9f}" for v in (t, *q)))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.mark.slow
def test_a_trajectory_is_followed_to_its_end_and_the_run_ends_there(robot: Robot) -> None:
    trajectory(robot.folder / "way.csv", robot.settings.start_q, 0.2, 1.5)
    cell = robot.cell(setpoints="{source: trajectory, file: way.csv}")
    with Run(cell, arm=True) as run:
        summary = run.join()
    assert summary.exit_code == 0
    cycles = run.cycles()
    assert cycles["nominal_q_0"][cycles["written"] > 0][-1] == pytest.approx(0.2, abs=1e-4)
    assert cycles["actual_q_0"][-1] == pytest.approx(0.2, abs=1e-3)


@pytest.mark.slow
def test_a_trajectory_that_begins_elsewhere_is_refused_and_nothing_moves(robot: Robot) -> None:
    away = (0.5, *robot.settings.start_q[1:])
    trajectory(robot.folder / "way.csv", away, 0.2, 1.0)
    cell = robot.cell(setpoints="{source: trajectory, file: way.csv, arm: true}")
    before = robot.truth()["true_tcp"]
    with Run(cell, arm=True, duration=0.5) as run:
        summary = run.join()
    assert summary.exit_code == 1
    assert any("joint 1: found the first setpoint 0.5000 rad" in line for line in summary.faults)
    assert robot.truth()["true_tcp"] == before


@pytest.mark.slow
def test_a_planner_moves_the_arm_and_its_silence_is_a_smooth_hold(robot: Robot) -> None:
    cell = robot.cell(setpoints="{source: planner, socket: planner.sock}")
    start = np.array(robot.settings.start_q)
    with Run(cell, arm=True) as run:
        run.wait(State.ARMED)
        planner = socket.socket(socket.AF_UNIX)
        planner.connect(str(robot.folder / "planner.sock"))

        def send(q: np.ndarray) -> None:
            planner.sendall((json.dumps({"q": q.tolist()}) + "\n").encode())
            time.sleep(0.01)  # 100 lines a second

        while run.daemon.state == State.ARMED:  # a planner waits until it is listened to
            send(start)
        for k in range(150):
            send(start + 0.002 * k * np.eye(6)[0])
        assert run.daemon.state == State.COMPENSATING
        planner.close()
        wait_for(lambda: run.daemon.state == State.OBSERVING, "hold and ramp out")
        summary = run.end()
    assert any("source dry" in line for line in summary.faults)
    assert summary.cause == Cause.SOURCE_DRY
    cycles = run.cycles()
    written = cycles["written"] > 0
    nominal = cycles["nominal_q_0"][written]
    assert nominal[-1] == pytest.approx(0.3, abs=0.02)
    rate = np.diff(nominal) / np.diff(cycles["timestamp"][written])
    assert np.quantile(np.abs(rate), 0.98) < 0.6  # late lines are caught up with, within limits
    assert np.abs(rate).max() < 2.1  # rad/s, the arm's own limit
    assert rate[-1] == 0.0  # it came to rest before the writing ended
    moved = offsets(cycles)[written]
    assert np.abs(moved[-1]).max() == 0.0
