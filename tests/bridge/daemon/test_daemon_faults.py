"""What the daemon survives, and that it never comes back writing."""

from __future__ import annotations

import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import psutil
import pytest
from daemon_cell import Robot, Run, gapbridge, offsets, only_recording, read_cycles
from patience import PATIENCE, wait_for

from gapbridge.bridge.ipc.loop_state import State
from gapbridge.core.errors import CellError, InputError, LinkError


def assert_came_back_observing(run: Run, robot: Robot) -> None:
    """The last words for every fault: observing again, and not a setpoint since."""
    run.wait(State.OBSERVING)
    run.cycle(250)
    assert run.daemon.state == State.OBSERVING
    summary = run.end()
    cycles = run.cycles()
    writing = np.flatnonzero(cycles["written"] > 0)
    assert len(writing) > 50
    assert cycles["state"][-1] == "observing"
    assert len(cycles["written"]) - writing[-1] > 100
    assert summary.faults


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_a_loop_that_dies_comes_back_observing(robot: Robot, number: signal.Signals) -> None:
    with Run(robot.cell(), arm=True) as run:
        run.compensate()
        run.write(60)
        pid = run.daemon.loop_pid
        assert pid is not None
        os.kill(pid, number)
        wait_for(lambda: run.daemon.loop_pid not in (None, pid), "a new loop")
        assert_came_back_observing(run, robot)
    assert run.summary is not None
    assert run.summary.restarts >= 1  # a stalled machine ends further loops
    assert run.summary.exit_code == 0
    assert any(number.name in line for line in run.summary.faults)
    # the robot's own watchdog has ended the script meanwhile
    assert "watchdog" in robot.controller.log()


@pytest.mark.slow
@pytest.mark.realtime(limit=0.3)
def test_a_loop_that_hangs_is_ended_and_comes_back_observing(robot: Robot) -> None:
    with Run(robot.cell(), arm=True, hang_timeout=1.0) as run:
        run.compensate()
        run.write(60)
        pid = run.daemon.loop_pid
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)
        wait_for(lambda: run.daemon.loop_pid != pid, "the end of the hanging loop", within=2.0)
        assert_came_back_observing(run, robot)
    assert run.summary is not None
    assert any("no heartbeat" in line for line in run.summary.faults)


@pytest.mark.slow
def test_a_controller_that_stands_still_is_a_fault(robot: Robot) -> None:
    with Run(robot.cell(), arm=True) as run:
        run.compensate()
        run.write(60)
        os.kill(robot.controller.pid, signal.SIGSTOP)
        try:
            run.wait(State.DISCONNECTED)
        finally:
            os.kill(robot.controller.pid, signal.SIGCONT)
        assert_came_back_observing(run, robot)
    assert any("clock has stopped" in line for line in run.output)


@pytest.mark.slow
def test_a_clock_that_stands_still_is_seen_though_packets_flow(robot: Robot) -> None:
    with Run(robot.cell()) as run:
        run.wait(State.OBSERVING)
        robot.bench("freeze")
        wait_for(lambda: run.daemon.status()["counts"]["silence"] == 1, "silence")
        robot.bench("thaw")
        run.wait(State.OBSERVING)
        assert run.daemon.latched == ""  # nothing was written, so nobody has to look
        summary = run.end()
    assert summary.restarts == 0
    assert summary.exit_code == 0


def test_a_clock_that_stands_still_ends_compensating(robot: Robot) -> None:
    with Run(robot.cell(), arm=True) as run:
        run.compensate()
        robot.bench("freeze")
        wait_for(lambda: "holding" in " ".join(run.output), "holding")
        assert "state stale" in " ".join(run.output)
        robot.bench("thaw")
        run.end()


@pytest.mark.slow
def test_a_short_stall_ramps_out_and_does_not_ramp_in_again(robot: Robot) -> None:
    with Run(robot.cell(), arm=True) as run:
        run.compensate()
        run.write(300)
        robot.bench("stall 0.08")
        run.wait(State.OBSERVING)
        assert_came_back_observing(run, robot)
    moved = offsets(run.cycles())
    steps = np.linalg.norm(np.diff(moved[:, :3], axis=0), axis=1)
    assert steps.max() <= 0.05 * 0.002 * 5.001


@pytest.mark.slow
def test_a_dropped_connection_is_replaced_by_a_new_process(robot: Robot) -> None:
    with Run(robot.cell(), arm=True) as run:
        run.compensate()
        run.write(60)
        robot.bench("drop")
        wait_for(lambda: run.daemon.state != State.COMPENSATING, "the fault")
        assert_came_back_observing(run, robot)


@pytest.mark.slow
def test_a_controller_that_is_started_anew_is_found_again(tmp_path: Path) -> None:
    with Robot(tmp_path) as robot, Run(robot.cell(), arm=True) as run:
        run.compensate()
        run.write(60)
        os.kill(robot.controller.pid, signal.SIGKILL)
        wait_for(lambda: run.daemon.state == State.DISCONNECTED, "the loss of the link")
        robot.controller.stop()
        robot.controller.start()
        assert_came_back_observing(run, robot)
    assert run.summary is not None
    assert run.summary.restarts >= 1


@pytest.mark.slow
def test_a_run_of_given_length_ends_also_where_its_controller_has_gone(tmp_path: Path) -> None:
    with Robot(tmp_path) as robot:
        cell = robot.cell(", connect_timeout: 1.0")
        with Run(cell, observe=True, duration=6.0) as run:
            run.wait(State.OBSERVING)
            os.kill(robot.controller.pid, signal.SIGKILL)
            summary = run.join()
        robot.controller.stop()
    assert summary.restarts >= 1


@pytest.mark.realtime(limit=0.03)  # later than that, a stalled loop has ended the motion
def test_a_protective_stop_is_a_fault_and_nobody_writes_after_it(robot: Robot) -> None:
    with Run(robot.cell(), arm=True) as run:
        run.compensate()
        run.write(60)
        robot.bench("protective_stop")
        run.wait(State.FAULT)
        run.cycle(250)
        assert run.daemon.state == State.FAULT
        summary = run.end()
    assert summary.exit_code == 1
    assert any("safety_mode 3" in line for line in summary.faults)
    cycles = run.cycles()
    fault = cycles["state"].index("fault")
    assert len(cycles["state"]) - fault > 200
    assert not cycles["written"][fault:].any()


@pytest.mark.slow
def test_a_stopped_robot_cannot_be_armed(robot: Robot) -> None:
    robot.bench("emergency_stop")
    with Run(robot.cell(), arm=True, duration=0.5) as run:
        summary = run.join()
    assert summary.exit_code == 1
    assert summary.setpoints_written == 0


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ramps_out_and_ends_in_time(robot: Robot, number: signal.Signals) -> None:
    start = np.array(robot.truth()["rigid_tcp"][:3])
    run = gapbridge("run", robot.cell(), "--arm", folder=robot.folder)
    assert run.stdout is not None
    while "compensating" not in run.stdout.readline():
        assert run.poll() is None
    wait_for(
        lambda: np.linalg.norm(np.array(robot.truth()["rigid_tcp"][:3]) - start) > 4.2e-4,
        "an offset",
    )
    asked = robot.clock()
    run.send_signal(number)
    out, err = run.communicate(timeout=PATIENCE)
    assert run.returncode == 0, err
    assert err == ""
    assert "setpoints written" in out
    cycles = read_cycles(only_recording(robot.folder / "recordings"))
    assert (cycles["timestamp"] > asked).sum() < 1000  # 2 s; without any other work half of it
    moved = np.linalg.norm(offsets(cycles)[:, :3], axis=1)
    assert moved.max() > 4e-4
    assert moved[-1] == 0.0
    assert np.abs(np.diff(moved)).max() <= 0.05 * 0.002 * 5.001


def lives(process: psutil.Process) -> bool:
    try:
        return str(process.status()) != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.mark.slow
def test_when_the_daemon_is_killed_its_loop_ramps_out_and_the_recording_is_whole(
    robot: Robot,
) -> None:
    run = gapbridge("run", robot.cell(), "--arm", folder=robot.folder)
    assert run.stdout is not None
    while "compensating" not in run.stdout.readline():
        assert run.poll() is None
    robot.elapse(0.7)
    family = psutil.Process(run.pid).children(recursive=True)
    killed = robot.clock()
    run.kill()
    run.wait()
    wait_for(lambda: "rtde_control ended" in robot.controller.log(), "the end of the loop")
    assert "watchdog" not in robot.controller.log()  # it ended by itself
    recording = only_recording(robot.folder / "recordings")
    wait_for(lambda: not any(map(lives, family)), "the end of the recorder")
    cycles = read_cycles(recording)
    span = cycles["timestamp"][-1] - cycles["timestamp"][0]
    assert span > 0.7
    assert cycles["timestamp"][-1] > killed


@pytest.mark.slow
def test_a_robot_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    run = gapbridge("run", robot.cell(), folder=tmp_path)
    out, err = run.communicate(timeout=PATIENCE)
    assert run.returncode == 1
    assert err.count("\n") == 1
    assert robot.host in err
    assert "Traceback" not in out + err


@contextmanager
def mute_server(host: str) -> Iterator[None]:
    """Something that takes connections on the RTDE port and never says a word."""
    taken = []
    with socket.create_server((host, 30004)) as listener:

        def accept() -> None:
            while True:
                try:
                    taken.append(listener.accept())
                except OSError:
                    return

        threading.Thread(target=accept, daemon=True).start()
        yield
        listener.shutdown(socket.SHUT_RDWR)
    for connection, _ in taken:
        connection.close()


def test_a_controller_that_never_answers_does_not_hang_the_daemon(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    with mute_server(robot.host), Run(robot.cell(link=", connect_timeout: 1.0")) as run:
        wait_for(lambda: run.error is not None, "the end of the run")
    assert isinstance(run.error, LinkError)


def test_a_cell_without_a_link_cannot_run(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text("robot: {model: ur10e}\n", encoding="utf-8")
    with pytest.raises(CellError, match="link: found nothing"):
        Run(path)


def test_motion_of_two_masters_is_refused(tmp_path: Path) -> None:
    robot = Robot(tmp_path)
    cell = robot.cell(link=", mode: offset", setpoints="{source: trajectory, file: way.csv}")
    with pytest.raises(CellError, match="the robot's own program moves the arm"):
        Run(cell)


@pytest.mark.slow
def test_a_trajectory_that_is_not_there_is_unusable_input(tmp_path: Path) -> None:
    with Robot(tmp_path) as robot:
        cell = robot.cell(setpoints="{source: trajectory, file: nowhere.csv}")
        with Run(cell, arm=True) as run:
            wait_for(lambda: run.error is not None, "the end of the run")
    assert isinstance(run.error, InputError)
    assert "nowhere.csv: file not found" in str(run.error)
