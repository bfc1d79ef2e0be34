"""What every simulated controller shares, whatever its protocol."""

from __future__ import annotations

import json
import math
import socket

import pytest

from benchmarks.server_thread import ServerThread
from gapbridge.core.arm import Arm, builtin_arm
from gapbridge.core.errors import ArmError, LinkError
from gapbridge.drivers.simulated.server.arm_controller import ArmController, make_controller
from gapbridge.drivers.simulated.server.bench import BenchError
from gapbridge.drivers.simulated.server.protocol_server import ProtocolServer
from gapbridge.drivers.simulated.ur.settings import simulated_arm

PERIOD = 0.004


def arm_of(n: int) -> Arm:
    arm = builtin_arm("ur5e")
    if n == 6:
        return arm
    rows = [0, 1, 2, 3, 4, 5, 5]
    return Arm(
        "seven", arm.link_in_link[[0, 1, 2, 3, 4, 5, 5, 6]], arm.mass[rows], arm.cog[rows],
        arm.inertia[rows], limits=type(arm.limits).none(7),
    )  # fmt: skip


def controller_of(n: int = 6) -> ArmController:
    return make_controller(*simulated_arm(arm_of(n), seed=3, payload_mass=2.0), period=PERIOD)


def run(controller: ArmController, seconds: float) -> None:
    for _ in range(round(seconds / controller.period)):
        controller.cycle()


@pytest.mark.parametrize("n", [6, 7])
def test_a_command_brings_the_plant_there(n: int) -> None:
    controller = controller_of(n)
    goal = tuple(q + 0.05 for q in controller.q)
    controller.command(goal)
    run(controller, 1.0)
    assert controller.q == pytest.approx(goal, abs=1e-9)
    assert controller.target_q == goal
    assert len(controller.temperatures) == len(controller.joint_torque) == n
    assert len(controller.tcp_force) == len(controller.raw_wrench) == 6


def test_the_flange_sensor_reads_the_payloads_weight() -> None:
    controller = controller_of()
    run(controller, 0.1)
    bias = controller.plant.settings.sensor_bias
    sensed = [v - b for v, b in zip(controller.raw_wrench[:3], bias, strict=False)]
    assert math.hypot(*sensed) == pytest.approx(2.0 * 9.80665, abs=1.5)


def test_the_own_program_moves_with_an_offset_on_top() -> None:
    controller = controller_of()
    goal = (0.3, *controller.q[1:])
    controller.move_own(goal)
    controller.offset_by((0.0, 0.0, 0.001, 0.0, 0.0, 0.0))
    run(controller, 3.0)
    assert controller.own_q == pytest.approx(goal)
    assert controller.q[2] == pytest.approx(goal[2] + 0.001, abs=1e-8)


def test_a_stop_brakes_and_refuses_commands_until_it_is_released() -> None:
    controller = controller_of()
    controller.command((controller.q[0] + 0.02, *controller.q[1:]))
    run(controller, 0.02)
    controller.emergency_stop()
    run(controller, 0.5)
    stands = controller.q
    controller.command((controller.q[0] + 0.02, *controller.q[1:]))
    with pytest.raises(BenchError):
        controller.move_own(stands)
    run(controller, 0.2)
    assert controller.q == pytest.approx(stands, abs=1e-6)
    controller.release_emergency_stop()
    controller.command((stands[0] + 0.02, *stands[1:]))
    run(controller, 0.5)
    assert controller.q[0] == pytest.approx(stands[0] + 0.02, abs=1e-6)


@pytest.mark.parametrize("bad", [math.nan, 100.0])
def test_a_command_that_cannot_be_is_a_protective_stop(bad: float) -> None:
    controller = controller_of()
    before = controller.q
    controller.command((bad, *before[1:]))
    run(controller, 0.1)
    assert controller.protective
    assert controller.q == pytest.approx(before, abs=1e-9)


def test_a_frozen_clock_stands_still_while_the_arm_goes_on() -> None:
    controller = controller_of()
    run(controller, 0.1)
    controller.frozen = True
    stood = controller.clock
    controller.move_own((0.3, *controller.q[1:]))
    before = controller.q
    run(controller, 0.4)
    assert controller.clock == stood
    assert controller.q != before


def test_a_start_with_another_number_of_joints_is_refused() -> None:
    with pytest.raises(ArmError, match="found 5 values, expected 6"):
        simulated_arm("ur5e", start_q=[0.0] * 5)


def ask(port: int, *lines: str) -> list[str]:
    with socket.create_connection(("127.0.0.1", port), 5.0) as bench:
        stream = bench.makefile("rw")
        answers = []
        for line in lines:
            stream.write(line + "\n")
            stream.flush()
            answers.append(stream.readline().strip())
        return answers


def test_the_bench_measures_and_hangs_loads_on_a_seven_joint_arm() -> None:
    with ServerThread(controller_of(7), [], "127.0.0.1") as served:
        output, truth, wrong = ask(
            served.loop.bench_port, "payload 3 0 0 0.1", "truth", "move 0 0 0 0 0 0"
        )
    assert output == "ok"
    assert json.loads(truth)["payload"]["mass"] == 3.0
    assert wrong == "error: move: found 6 numbers, expected 7"


class Counting(ProtocolServer):
    name = "counting"

    def __init__(self) -> None:
        self.cycles, self.dropped, self.closed = 0, 0, 0

    def cycle(self, controller: ArmController) -> None:
        self.cycles += 1

    def drop(self) -> None:
        self.dropped += 1

    def close(self) -> None:
        self.closed += 1


def test_servers_are_cycled_dropped_and_closed() -> None:
    server = Counting()
    with ServerThread(controller_of(), [server], "127.0.0.1") as served:
        assert ask(served.loop.bench_port, "drop") == ["ok"]
    assert server.cycles > 0
    assert (server.dropped, server.closed) == (1, 1)


def test_a_bench_port_that_is_taken_is_reported() -> None:
    with (
        ServerThread(controller_of(), [], "127.0.0.1") as served,
        pytest.raises(LinkError, match=r"127\.0\.0\.1: Address already in use"),
    ):
        ServerThread(controller_of(), [], "127.0.0.1", served.loop.bench_port).start()
