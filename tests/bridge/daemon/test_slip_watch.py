"""The watch over the joints' zeros: what it finds, when, and what it leaves alone."""

from __future__ import annotations

import numpy as np
import pytest
from simulated_daemon import ask, causes, rides_on_a_program, until

from benchmarks.zero_slips import COUNTS, SETUPS, SLICES, Program, Setup, found_in
from gapbridge.bridge.daemon.slip_watch import SlipWatch, slip_event
from gapbridge.bridge.daemon.status_document import lines
from gapbridge.bridge.ipc.command_memory import Command
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.core.diagnosis.rests.rest_comparison import Slip

LEARNING = 6 * COUNTS  # rests
ROUNDS = 2  # of the program, within which a slip of 10 mrad is found


def watch_of(program: Program, smallest: float = 0.003) -> SlipWatch:
    return SlipWatch(program.model, SLICES, smallest)


@pytest.mark.parametrize("joint", range(2, 7))
@pytest.mark.parametrize("setup", SETUPS[:2], ids=lambda setup: setup.name)
def test_a_slip_of_10_mrad_is_found_within_two_rounds(setup: Setup, joint: int) -> None:
    program = Program(setup, 100 + joint)
    watch = watch_of(program)
    assert found_in(watch, program, LEARNING)[:2] == ([], [])
    assert watch.learned
    program.slip(joint - 1, 0.010)
    slips, forces, _ = found_in(watch, program, ROUNDS * COUNTS + 1)
    assert len(slips) == 1
    assert forces == []
    joints, size = slips[0]["joints"], slips[0]["size"]
    assert joint in joints
    if joints[0] == joint:
        assert abs(size - 0.010) < 4.0 * slips[0]["std"]
    assert f"{1e3 * slips[0]['size']:.1f} mrad" in slips[0]["detail"]


def test_joints_with_parallel_axes_are_all_named_where_weights_cannot_part_them() -> None:
    program = Program(SETUPS[1], 5)  # a flange sensor alone: joints 2, 3 and 4 tilt it alike
    watch = watch_of(program)
    found_in(watch, program, LEARNING)
    program.slip(2, 0.02)
    (slip,), _, _ = found_in(watch, program, ROUNDS * COUNTS + 1)
    assert sorted(slip["joints"]) == [2, 3, 4]
    assert "joint " in slip["detail"] and " or " in slip["detail"]


def test_the_first_joint_turns_about_the_weights_and_shows_nothing() -> None:
    program = Program(SETUPS[0], 6)
    watch = watch_of(program)
    found_in(watch, program, LEARNING)
    program.slip(0, 0.05)
    assert found_in(watch, program, 4 * COUNTS)[:2] == ([], [])


@pytest.mark.slow
@pytest.mark.parametrize("setup", SETUPS, ids=lambda setup: setup.name)
def test_an_hour_without_a_slip_is_an_hour_without_a_word(setup: Setup) -> None:
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
    assert "an unexpected force of" in forces[0]["detail"]


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


def test_a_slip_holds_the_run_until_a_person_has_seen_it() -> None:
    with rides_on_a_program() as (run, world):
        daemon = run.daemon
        found = slip_event(Slip((4, 3), 0.0098, 0.0007, 12.0, 4))
        begun = world.now
        daemon._zeros.slips.take = lambda rows: [found] if world.now < begun + 0.02 else []  # type: ignore[method-assign]
        until(world, lambda: daemon.state == State.OBSERVING, 3.0)
        assert causes(run)[-2:] == ["zero moved", "ramped out"]
        (event,) = [e for e in daemon.event_log.recent if e["kind"] == "slip"]
        assert (event["joints"], event["size"]) == ([4, 3], 0.0098)
        status = daemon.status()
        assert status["counts"]["zero_moved"] == 1  # /metrics: gapbridge_incidents
        assert status["latched"] == found["detail"]
        assert "zero of joint 4" in "\n".join(lines(status))
        refused = ask(run, "arm")
        assert not refused["ok"]
        assert "a fault is latched: the zero of joint 4" in refused["error"]
        daemon.arm()  # past the answer: the daemon has another refusal
        until(world, lambda: daemon.event_log.counts["refused"] == 1, 3.0)
        daemon._commands.ask(Command.ARM)  # past the daemon: the loop has one of its own
        until(world, lambda: daemon.event_log.counts["refused"] == 2, 3.0)
        assert daemon.state == State.OBSERVING
        assert ask(run, "disarm")["ok"]
        assert daemon.status()["latched"] == ""
        assert ask(run, "arm")["answer"] == "compensating"


def test_a_slip_stays_latched_over_a_loop_that_dies() -> None:
    with rides_on_a_program() as (run, world):
        daemon, begun = run.daemon, world.now
        found = slip_event(Slip((2,), 0.02, 0.001, 1.0, 4))
        daemon._zeros.slips.take = lambda rows: [found] if world.now < begun + 0.02 else []  # type: ignore[method-assign]
        until(world, lambda: daemon.state == State.OBSERVING, 3.0)
        run.loops[-1].kill()
        until(world, lambda: len(run.loops) > 1 and daemon.state == State.FAULT, 10.0)
        assert not ask(run, "arm")["ok"]
        assert ask(run, "disarm")["ok"]
        assert ask(run, "arm")["answer"] == "compensating"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_zero_that_slips_in_a_run_is_found_within_three_rounds_of_its_program() -> None:
    rng = np.random.default_rng(4)
    with rides_on_a_program() as (run, world):
        link, events = run.link, run.daemon.event_log
        sensors = link.controller.sensors
        del sensors.update  # in every cycle again: its own program moves this arm fast
        world.every(lambda: 0.1, lambda: sensors.update_slowly(link.controller.clock))
        home = np.array(link.setting.wired.start_q)
        poses = home + rng.uniform(-0.5, 0.5, (COUNTS, 6)) * [1, 0.6, 0.6, 1.4, 1.4, 1.4]

        def go_round(rounds: int) -> None:
            for pose in np.tile(poses, (rounds, 1)):
                link.controller.move_own(tuple(pose))
                until(world, lambda goal=tuple(pose): link.controller.own_q == goal)
                world.run(world.now + 0.8, lambda: events.counts["slip"] > 0)

        go_round(5)
        assert run.daemon._zeros.slips.learned
        assert run.daemon.state == State.COMPENSATING
        assert events.counts["warning"] == events.counts["slip"] == 0
        link.controller.plant.slip(4, 0.010)
        go_round(3)
        (event,) = [e for e in events.recent if e["kind"] == "slip"]
        assert 5 in event["joints"]
        assert "zero moved" in causes(run)
