"""The watch over the joints' zeros: what it finds, when, and what it leaves alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from daemon_cell import Robot, Run, gapbridge, wait_for

from benchmarks.zero_slips import COUNTS, SETUPS, SLICES, Program, found_in
from gapbridge.bridge.daemon.slip_watch import SlipWatch
from gapbridge.bridge.demo.trajectory import visits, write_trajectory
from gapbridge.bridge.loop.supervisor import State

LEARNING = 6 * COUNTS  # rests
ROUNDS = 2  # of the program, within which a slip of 10 mrad is found


def watch_of(program: Program, smallest: float = 0.003) -> SlipWatch:
    return SlipWatch(program.model, SLICES, smallest)


@pytest.mark.parametrize("joint", range(2, 7))
@pytest.mark.parametrize("setup", SETUPS[:2], ids=lambda setup: setup.name)
def test_a_slip_of_10_mrad_is_found_within_two_rounds(setup, joint: int) -> None:  # type: ignore[no-untyped-def]
    program = Program(setup, 100 + joint)
    watch = watch_of(program)
    assert found_in(watch, program, LEARNING)[:2] == ([], [])
    assert watch.learned
    program.slip(joint - 1, 0.010)
    slips, forces, _ = found_in(watch, program, ROUNDS * COUNTS + 1)
    assert len(slips) == 1
    assert forces == []
    assert joint in slips[0].joints
    if slips[0].joints[0] == joint:
        assert abs(slips[0].size - 0.010) < 4.0 * slips[0].std
    assert f"{1e3 * slips[0].size:.1f} mrad" in slips[0].detail


def test_joints_with_parallel_axes_are_all_named_where_weights_cannot_part_them() -> None:
    program = Program(SETUPS[1], 5)  # a flange sensor alone: joints 2, 3 and 4 tilt it alike
    watch = watch_of(program)
    found_in(watch, program, LEARNING)
    program.slip(2, 0.02)
    (slip,), _, _ = found_in(watch, program, ROUNDS * COUNTS + 1)
    assert sorted(slip.joints) == [2, 3, 4]
    assert "joint " in slip.detail and " or " in slip.detail


def test_the_first_joint_turns_about_the_weights_and_shows_nothing() -> None:
    program = Program(SETUPS[0], 6)
    watch = watch_of(program)
    found_in(watch, program, LEARNING)
    program.slip(0, 0.05)
    assert found_in(watch, program, 4 * COUNTS)[:2] == ([], [])


@pytest.mark.slow
@pytest.mark.parametrize("setup", SETUPS, ids=lambda setup: setup.name)
def test_an_hour_without_a_slip_is_an_hour_without_a_word(setup) -> None:  # type: ignore[no-untyped-def]
    program = Program(setup, 7)
    watch = watch_of(program)
    assert found_in(watch, program, 2250)[:2] == ([], [])
    assert watch.learned


def test_ten_minutes_without_a_slip_are_without_a_word() -> None:
    program = Program(SETUPS[0], 8)
    assert found_in(watch_of(program), program, 375)[:2] == ([], [])


def test_a_hand_on_the_arm_is_a_force_and_no_slip() -> None:
    program = Program(SETUPS[0], 9)
    watch = watch_of(program)
    found_in(watch, program, LEARNING)
    slips, forces, hands = found_in(watch, program, 200, touched=0.1)
    assert slips == []
    assert hands > 10
    assert len(forces) > 0.4 * hands  # those of a few newtons, or shorter than a window, pass
    assert "an unexpected force of" in forces[0].detail


def test_a_sensor_that_is_zeroed_anew_and_a_heavier_part_are_no_slips() -> None:
    program = Program(SETUPS[0], 10)
    watch = watch_of(program)
    found_in(watch, program, LEARNING)
    program._drift[:6] += (1.5, -1.0, 2.0, 0.1, 0.0, -0.1)  # N, Nm
    assert found_in(watch, program, 4 * COUNTS)[0] == []
    program.load(0.3)  # kg that nobody declared
    assert found_in(watch, program, 4 * COUNTS)[0] == []


@pytest.mark.parametrize("smallest", [0.0, 0.05])
def test_a_slip_below_what_the_cell_says_is_left_alone(smallest: float) -> None:
    program = Program(SETUPS[0], 11)
    watch = watch_of(program, smallest)
    found_in(watch, program, LEARNING)
    program.slip(4, 0.02)
    assert found_in(watch, program, 3 * COUNTS)[0] == []


def test_without_poses_that_come_back_nothing_is_compared() -> None:
    program = Program(SETUPS[0], 12)
    watch = watch_of(program)
    for seed in range(8):
        program.poses = Program(SETUPS[0], 200 + seed).poses
        program.slip(3, 0.0)
        assert found_in(watch, program, COUNTS)[:2] == ([], [])
    assert "learning" in watch.detail


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    with Robot(tmp_path) as found:
        yield found


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_run_whose_zero_slips_holds_and_stays_held_until_a_person_has_seen_it(
    robot: Robot, tmp_path: Path
) -> None:
    home = np.array(robot.settings.start_q)
    rng = np.random.default_rng(4)
    poses = home + rng.uniform(-0.35, 0.35, (6, 6))
    round_of = visits(home, poses, 0.6)
    one = len(visits(poses[-1], poses, 0.6)) * 0.002  # s of a round, or a little less
    write_trajectory(tmp_path / "way.csv", visits(home, np.tile(poses, (14, 1)), 0.6))
    cell = robot.cell(", rate: 125", setpoints="{source: trajectory, file: way.csv}")
    assert len(round_of)
    with Run(cell) as run:
        run.wait(State.OBSERVING)
        run.compensate()
        daemon = run.daemon
        wait_for(lambda: daemon._slips.learned, 90, "learned")
        assert daemon.state == State.COMPENSATING
        assert robot.bench("slip 5 0.010") == "ok"
        took = wait_for(lambda: daemon.event_log.counts["slip"] > 0, 3 * one, "a slip is found")
        assert took < 2.5 * one
        (event,) = [e for e in daemon.event_log.kept if e["kind"] == "slip"]
        assert 5 in event["joints"]
        assert abs(event["size"] - 0.010) < 4 * event["std"] + 0.001
        wait_for(lambda: daemon.state == State.OBSERVING, 5, "ramped out")
        causes = [e["cause"] for e in daemon.event_log.kept if e["kind"] == "transition"]
        assert causes[-2:] == ["zero moved", "ramped out"]
        status = daemon.status()
        assert status["counts"]["zero_moved"] == 1  # of /metrics: gapbridge_incidents
        assert "zero of joint" in status["latched"]
        refused = gapbridge("arm", cell, folder=tmp_path)
        assert refused.wait(30) == 1
        assert "a fault is latched" in refused.communicate()[1]
        daemon.arm()  # past the refusal of the daemon: the loop has one of its own
        wait_for(lambda: daemon.event_log.counts["refused"] > 0, 5, "refused")
        assert daemon.state == State.OBSERVING
        assert gapbridge("disarm", cell, folder=tmp_path).wait(30) == 0
        assert daemon.status()["latched"] == ""
        assert not daemon._slips.learned
