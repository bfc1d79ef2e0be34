from __future__ import annotations

import socket
from itertools import pairwise

import numpy as np
import pytest
from rtde_client import RtdeClient
from simulated_cell import Bench, cell_settings
from simulated_controller import SimulatedController

from gapbridge.drivers.simulated.server.bench import BenchServer
from gapbridge.drivers.simulated.ur.settings import make_controller


def reader(host: str, names: str) -> RtdeClient:
    client = RtdeClient(host)
    client.outputs(names)
    client.start()
    return client


def average(client: RtdeClient, name: str, count: int = 300) -> np.ndarray:
    for _ in range(20):
        client.sample()
    return np.mean([client.sample()[name] for _ in range(count)], axis=0)


def test_the_tracker_measures_the_true_tcp_with_its_noise(bench: Bench) -> None:
    truth = bench.truth()
    rows = np.array([bench.measure() for _ in range(400)])
    error = rows[:, 1:4] - truth["true_tcp"][:3]
    assert error.std() == pytest.approx(2e-5, rel=0.15)
    assert np.abs(error.mean(axis=0)).max() < 5e-6
    assert np.abs(rows[:, 4:] - truth["true_tcp"][3:]).max() < 3e-4


def test_a_load_bends_the_arm_and_weighs_in_the_sensor(
    controller: SimulatedController, bench: Bench
) -> None:
    before = bench.truth()
    bench.do("payload 5 0.01 0 0.06")
    after = bench.truth()
    assert after["payload"] == {"mass": 5.0, "cog": [0.01, 0.0, 0.06]}
    assert before["true_tcp"][2] - after["true_tcp"][2] > 5e-5
    assert after["rigid_tcp"] == before["rigid_tcp"]
    client = reader(controller.host, "ft_raw_wrench,actual_TCP_force,actual_TCP_pose")
    raw = average(client, "ft_raw_wrench") - after["sensor_bias"]
    weight = 5.0 * 9.80665
    # The tool points down: the flange's z is base -z, so a weight reads as a pull along +z.
    assert raw[2] == pytest.approx(weight, abs=0.2)
    assert np.abs(raw[:2]).max() < 0.3
    # The controller does not know of the load, so it takes it for an outside force.
    force = average(client, "actual_TCP_force")
    assert force[2] == pytest.approx(-weight, abs=0.2)


def test_a_pull_at_the_tcp_reads_in_base_axes(
    controller: SimulatedController, bench: Bench
) -> None:
    bench.do("wrench 10 -20 30 1 2 -3")
    client = reader(controller.host, "actual_TCP_force,tcp_force_scalar")
    force = average(client, "actual_TCP_force")
    assert force == pytest.approx([10, -20, 30, 1, 2, -3], abs=0.2)
    assert average(client, "tcp_force_scalar") == pytest.approx(37.4, abs=0.3)


def test_a_declared_payload_is_not_counted_in_the_tcp_force() -> None:
    settings = cell_settings(payload_mass=4.0, payload_cog=(0.0, 0.02, 0.05))
    with SimulatedController(settings):
        client = reader(settings.host, "actual_TCP_force,payload,payload_cog")
        assert np.abs(average(client, "actual_TCP_force")).max() < 0.2
        sample = client.sample()
    assert sample["payload"] == 4.0
    assert sample["payload_cog"] == [0.0, 0.02, 0.05]


def test_joint_torques_hold_what_hangs_on_the_arm(
    controller: SimulatedController, bench: Bench
) -> None:
    names = "actual_current_as_torque,target_moment,actual_TCP_pose"
    client = reader(controller.host, names)
    empty = average(client, "actual_current_as_torque")
    assert empty == pytest.approx(average(client, "target_moment"), abs=0.1)
    bench.do("wrench 0 0 -20 0 0 0")
    client = reader(controller.host, names)  # samples from before it may wait in the other's socket
    loaded = average(client, "actual_current_as_torque")
    lever = np.hypot(*client.sample()["actual_TCP_pose"][:2])
    # The elbow-up arm reaches out in its own plane; lifting 20 N more takes torque at the shoulder.
    assert 0.9 * 20.0 * 0.7 < abs(loaded[1] - empty[1]) < 20.0 * lever


def test_a_moving_payload_shows_its_inertia_in_the_raw_sensor_only() -> None:
    settings = cell_settings(payload_mass=8.0, force_noise=0.0, torque_noise=0.0)
    with SimulatedController(settings):
        bench = Bench(settings.host)
        client = reader(settings.host, "ft_raw_wrench,actual_TCP_force")
        still = client.sample()["ft_raw_wrench"]
        bench.do("move 0.4 -1.5 1.8 -1.87 -1.57 0")
        rows = [client.sample() for _ in range(500)]
        bench.close()
    raw = np.array([r["ft_raw_wrench"] for r in rows]) - still
    tcp = np.array([r["actual_TCP_force"] for r in rows])
    assert np.abs(raw[:, :2]).max() > 3.0
    assert np.abs(tcp[:, :3]).max() < 0.5


def test_temperatures_rise_slowly() -> None:
    settings = cell_settings(temperature_time=1.0)
    with SimulatedController(settings):
        client = reader(settings.host, "joint_temperatures")
        first = client.sample()["joint_temperatures"]
        for _ in range(350):
            later = client.sample()["joint_temperatures"]
    assert all(b > a for a, b in zip(first, later, strict=True))
    assert max(later) < settings.plant.ambient_temperature + 1.3 * settings.plant.temperature_rise


def test_freeze_holds_the_timestamp_while_packets_flow_and_thaw_lets_it_go(
    controller: SimulatedController, bench: Bench
) -> None:
    client = reader(controller.host, "timestamp")
    bench.do("freeze")
    for _ in range(50):
        client.sample()
    assert client.sample() == client.sample()
    bench.do("thaw")
    for _ in range(50):
        client.sample()
    assert client.sample() != client.sample()


def test_a_stall_stops_the_packets_for_its_time(
    controller: SimulatedController, bench: Bench
) -> None:
    client = reader(controller.host, "timestamp")
    stamps = [client.sample()["timestamp"]]
    bench.do("stall 0.3")
    stamps += [client.sample()["timestamp"] for _ in range(200)]
    assert max(b - a for a, b in pairwise(stamps)) == pytest.approx(0.3, abs=0.05)


def test_drop_closes_every_rtde_connection(controller: SimulatedController, bench: Bench) -> None:
    client = reader(controller.host, "timestamp")
    bench.do("drop")
    with pytest.raises((EOFError, ConnectionError)):
        [client.sample() for _ in range(1000)]
    assert reader(controller.host, "timestamp").sample()["timestamp"] > 0.0


def test_an_emergency_stop_takes_the_power_and_coming_back_takes_every_step(
    controller: SimulatedController, bench: Bench
) -> None:
    client = reader(controller.host, "robot_mode,safety_mode,runtime_state,safety_status_bits")
    bench.do("emergency_stop")
    for _ in range(5):
        sample = client.sample()
    assert (sample["robot_mode"], sample["safety_mode"], sample["runtime_state"]) == (3, 7, 1)
    assert sample["safety_status_bits"] == 1 << 6 | 1 << 7 | 1 << 10
    assert bench.ask("move 0 0 0 0 0 0").startswith("error: ")
    dashboard = socket.create_connection((controller.host, 29999), timeout=5)
    lines = dashboard.makefile("rw", newline="\n")
    assert "Dashboard" in lines.readline()

    def ask(text: str) -> str:
        lines.write(text + "\n")
        lines.flush()
        return lines.readline().strip()

    assert ask("power on") == "Failed to execute: power on"
    bench.do("release")
    assert ask("power on") == "Powering on"
    assert ask("robotmode") == "Robotmode: IDLE"
    assert ask("brake release") == "Brake releasing"
    assert ask("robotmode") == "Robotmode: RUNNING"
    bench.do("move 0 -1.5 1.8 -1.87 -1.57 0.1")


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("dance", "unknown command"),
        ("payload 1 2", "found 2 numbers, expected 4"),
        ("payload a b c d", "expected numbers"),
        ("payload nan 0 0 0", "expected finite numbers"),
        ("payload -1 0 0 0", "expected 0 to"),
        ("move 0 0 0", "found 3 numbers, expected 6"),
    ],
)
def test_a_mistake_on_the_bench_is_reported(bench: Bench, line: str, reason: str) -> None:
    answer = bench.ask(line)
    assert answer.startswith("error: ")
    assert reason in answer
    assert "measure" in bench.ask("help")


@pytest.mark.parametrize(
    ("line", "phrase"),
    [
        ("wrench 1e200 0 0 0 0 0", "wrench: found 1e+200 N or Nm, expected at most 10000"),
        ("wrench 0 0 0 0 0 -20000", "wrench: found -20000 N or Nm, expected at most 10000"),
        ("payload 1 0 1e300 0", "payload: found 1e+300 m, expected at most 10"),
        ("slip 2 1e17", "slip: found 1e+17 rad, expected at most 3.14159"),
    ],
)
def test_numbers_that_end_no_equilibrium_are_refused_and_the_controller_goes_on(
    line: str, phrase: str
) -> None:
    controller = make_controller(cell_settings())
    bench = BenchServer(controller, lambda: None, lambda _: None)
    assert bench.answer(line) == f"error: {phrase}"
    for _ in range(11):
        controller.cycle()
        controller.sensors.after_cycle(controller.clock)
    assert bench.answer("payload 200 10 0 0") == bench.answer("slip 2 -3") == "ok"
    assert bench.answer("wrench 1e4 0 0 0 0 1e4") == "ok"
    assert np.isfinite([float(v) for v in bench.answer("measure").split(",")]).all()
