"""The daemon with a sensor that fails: observing and writing, and what becomes of the arm."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gapbridge.drivers.clock import SYSTEM

BRIDGE = str(Path(__file__).resolve().parents[2] / "bridge")
sys.path.insert(0, BRIDGE)

from daemon_cell import Robot, Run, offsets  # noqa: E402
from patience import wait_for  # noqa: E402
from sensor_wires import Reaction  # noqa: E402

from gapbridge.bridge.ipc.loop_state import State  # noqa: E402
from gapbridge.drivers.can_bus.bus import BusSettings  # noqa: E402
from gapbridge.drivers.simulated.can.hub import Hub  # noqa: E402
from gapbridge.drivers.simulated.ft_sensor.ati_node import RobotousNode  # noqa: E402

WEIGHT = (0.0, 0.0, 49.0, 0.0, 0.0, 0.0)


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    with Robot(tmp_path) as found:
        yield found


@pytest.fixture
def sensor(robot: Robot) -> Iterator[RobotousNode]:
    with Hub(SYSTEM, robot.host) as hub:
        bus = BusSettings(interface="socketcand", host=robot.host, port=hub.port)
        with RobotousNode(Reaction(WEIGHT), bus, SYSTEM) as node:
            yield node


def cell_of(robot: Robot, sensor: RobotousNode, when_lost: str = "stop") -> Path:
    return robot.cell(
        ", state_timeout: 0.25",
        ft_sensor=f"{{driver: robotous_rft, interface: socketcand, host: {robot.host}, "
        f"port: {sensor._settings.port}, max_age: 0.1, when_lost: {when_lost}}}",
    )


@pytest.mark.slow
def test_a_silent_sensor_is_seen_and_its_return_is_observed(
    robot: Robot, sensor: RobotousNode
) -> None:
    with Run(cell_of(robot, sensor), observe=True) as run:
        run.wait(State.OBSERVING)
        run.cycle(250)
        sensor.silent = True
        wait_for(lambda: run.daemon.status()["counts"]["silence"] == 1, "silence")
        sensor.silent = False
        run.wait(State.OBSERVING)
        assert run.daemon.latched == ""  # nothing was written, so nobody has to look
        run.cycle(150)
        run.end()
        raw = np.stack([run.cycles()[f"ft_raw_wrench_{i}"] for i in range(6)], axis=1)
    assert any("robotous_rft" in line and "max_age" in line for line in run.output), run.output
    assert np.abs(raw - WEIGHT).max() <= 0.02  # not one cycle with another wrench


@pytest.mark.slow
def test_a_sensor_lost_while_writing_ends_the_writing_until_a_person_arms_again(
    robot: Robot, sensor: RobotousNode
) -> None:
    with Run(cell_of(robot, sensor), arm=True) as run:
        run.write(250)
        sensor.silent = True
        wait_for(lambda: run.daemon.state != State.COMPENSATING, "no longer compensating")
        robot.elapse(1.0)
        sensor.silent = False
        run.wait(State.OBSERVING)
        run.cycle(500)
        assert run.daemon.state == State.OBSERVING
        begun = robot.truth()["true_tcp"]
        robot.elapse(0.5)
        assert np.allclose(robot.truth()["true_tcp"], begun, atol=1e-4)
        run.end()
    assert robot.truth()["largest_servo_step"] < 0.01


def test_overload_stops_the_writing(robot: Robot, sensor: RobotousNode) -> None:
    with Run(cell_of(robot, sensor), arm=True) as run:
        run.compensate()
        sensor.status = 0x10
        wait_for(lambda: run.daemon.state != State.COMPENSATING, "no longer compensating")
        run.end()
    assert any("overload" in line for line in run.output), run.output


@pytest.mark.slow
def test_a_lost_sensor_drops_the_force_and_the_angles_stay_corrected(
    robot: Robot, sensor: RobotousNode
) -> None:
    with Run(cell_of(robot, sensor, "degrade"), arm=True) as run:
        run.write(500)
        sensor.silent = True
        wait_for(lambda: any("max_age" in line for line in run.output), "the event")
        run.cycle(250)
        sensor.silent = False
        wait_for(lambda: "the sensor is back" in run.output, "the sensor")
        run.cycle(150)
        assert run.daemon.state == State.COMPENSATING
        status = run.daemon.status()
        summary = run.end()
        cycles = run.cycles()
    assert status["counts"]["sensor_lost"] == 1
    assert summary.restarts == 0
    lost = np.isnan(cycles["ft_raw_wrench_0"])
    assert lost.sum() >= 250
    assert not lost[:500].any()
    assert not lost[-100:].any()
    moved = offsets(cycles)[:, :3]
    assert np.linalg.norm(moved[lost], axis=1).min() > 1e-4  # the payload's part stays
    assert np.linalg.norm(np.diff(moved, axis=0), axis=1).max() <= 0.05 * 0.002 * 5.001
