"""A cell with a sensor: served by ``simulate``, read beside the UR, observed by ``run``."""

from __future__ import annotations

import csv
import json
import os
import socket
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE
from ports import own_host

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.recording.export import export
from gapbridge.core.errors import InputError
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.ft_sensor.settings import RobotiqSettings
from gapbridge.drivers.simulated.ft_sensor.serving import served_sensor
from gapbridge.drivers.simulated.ur.settings import BENCH_PORT

ROOT = Path(__file__).resolve().parents[3]
MASS, COG = 5.0, (0.0, 0.0, 0.06)
SECTIONS = {
    "robotous_rft": "driver: robotous_rft, interface: socketcand, host: {host}",
    "ati_netcanoem": "driver: ati_netcanoem, interface: socketcand, host: {host}",
    "robotiq_ft300": "driver: robotiq_ft300, port: {folder}/ft300",
}


def cell_in(folder: Path, kind: str, more: str = "") -> Path:
    host = own_host()
    section = SECTIONS[kind].format(host=host, folder=folder)
    text = f"""\
        robot: {{model: ur10e}}
        tool: {{tcp: {{xyz: [0, 0, 0.2], rpy: [0, 0, 0]}}}}
        payload: {{mass: {MASS}, cog: {list(COG)}}}
        link: {{driver: ur_rtde, host: {host}, state_timeout: 0.25}}
        ft_sensor: {{{section}, max_age: 0.3, sensor_in_flange:
          {{xyz: [0, 0.01, 0.04], rpy: [0.1, 0, 0.8]}}{more}}}
        recording: {{folder: recordings}}
        simulation: {{seed: 4}}
        """
    path = folder / "cell.yaml"
    path.write_text(textwrap.dedent(text), encoding="utf-8")
    return path


def environment() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *(p for p in sys.path if p)])}


@contextmanager
def simulated(cell: Path) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-m", "gapbridge", "simulate", str(cell)], env=environment(),
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    try:
        output = ""
        while "ready" not in output:
            line = process.stdout.readline()
            output += line
            assert line, output
        yield process
    finally:
        process.terminate()
        assert process.wait(PATIENCE) == 0
        process.stdout.close()


def bench(cell: Path, line: str) -> str:
    link = load_cell(cell).link
    with socket.create_connection(
        (getattr(link, "host", ""), BENCH_PORT), timeout=PATIENCE
    ) as connection:
        connection.sendall(line.encode() + b"\n")
        return connection.makefile("r").readline().strip()


def run_python(code: str, *arguments: object) -> dict[str, Any]:
    """Run code in a process of its own, which ur_rtde may hang or crash; returns its JSON."""
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)], env=environment(),
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def recorded(folder: Path) -> list[dict[str, str]]:
    """Return the rows of the one recording there."""
    (recording,) = (folder / "recordings").glob("run-*.mcap")
    log = recording.with_suffix(".csv")
    export(recording, log)
    with log.open(encoding="utf-8") as lines:
        return list(csv.DictReader(lines))


READ_BOTH = """
    import json, os, sys
    import numpy as np
    from gapbridge.bridge.cell import load_cell
    from gapbridge.drivers import make_driver
    from gapbridge.drivers.ft_sensor.joined import DriverWithSensor

    cell = load_cell(sys.argv[1])
    arm = make_driver(cell.link, cell.model)
    own, plain = [], arm.read_state
    def read_state():
        state = plain()
        own.append(state.ft_raw_wrench)
        return state
    arm.read_state = read_state
    driver = DriverWithSensor(arm, cell.ft_sensor, cell.model)
    driver.connect()
    states = [driver.read_state() for _ in range(500)]
    mean = lambda rows: np.mean(rows, axis=0).tolist()
    print(json.dumps({
        "arm": mean(own), "sensor": mean([s.ft_raw_wrench for s in states]),
        "force": mean([s.actual_TCP_force for s in states]), "q": states[-1].actual_q.tolist(),
        "gap": float(np.max(np.diff([s.timestamp for s in states]))),
    }), flush=True)
    os._exit(0)
"""


@pytest.mark.slow
def test_beside_a_simulated_ur_the_sensor_reads_what_the_arms_own_reads(tmp_path: Path) -> None:
    cell = cell_in(tmp_path, "robotous_rft")
    with simulated(cell):
        bias = np.array(json.loads(bench(cell, "truth"))["sensor_bias"])
        bare = run_python(READ_BOTH, cell)
        assert bench(cell, "wrench 10 -5 30 0 0 0.5") == "ok"
        pulled = run_python(READ_BOTH, cell)
    assert bare["sensor"][:3] == pytest.approx(bare["arm"][:3], abs=0.1)
    assert bare["sensor"][3:] == pytest.approx(bare["arm"][3:], abs=0.01)
    # the sensor's zero is off, as the truth says; nobody else pulls
    assert np.linalg.norm(bare["force"][:3]) == pytest.approx(np.linalg.norm(bias[:3]), abs=0.3)
    change = np.array(pulled["force"]) - bare["force"]
    assert change[:3] == pytest.approx((10, -5, 30), abs=0.15)
    assert change[3:] == pytest.approx((0, 0, 0.5), abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(SECTIONS))
def test_run_observes_and_records_the_sensors_wrench(tmp_path: Path, kind: str) -> None:
    cell = cell_in(tmp_path, kind)
    with simulated(cell):
        truth = json.loads(bench(cell, "truth"))
        done = subprocess.run(
            [sys.executable, "-m", "gapbridge", "run", str(cell), "--observe", "--duration", "2"],
            env=environment(), capture_output=True, text=True, timeout=PATIENCE, check=False,
        )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    rows = recorded(tmp_path)
    assert len(rows) > 400
    raw = np.array([[float(r[f"ft_raw_wrench_{i}"]) for i in range(6)] for r in rows])
    bias = np.array(truth["sensor_bias"])
    weight = raw.mean(axis=0)[:3] - bias[:3]
    assert np.linalg.norm(weight) == pytest.approx(MASS * 9.80665, abs=0.15)
    torque = raw.mean(axis=0)[3:] - bias[3:]
    assert torque == pytest.approx(np.cross(COG, weight), abs=0.02)


@pytest.mark.slow
def test_arm_and_sensor_share_one_can_bus(tmp_path: Path) -> None:
    cell = cell_in(tmp_path, "robotous_rft")
    text = cell.read_text(encoding="utf-8").replace(
        "{driver: ur_rtde, ", "{driver: can, profile: piper, interface: socketcand, "
    )
    cell.write_text(text, encoding="utf-8")
    with simulated(cell):
        bias = np.array(json.loads(bench(cell, "truth"))["sensor_bias"])
        done = subprocess.run(
            [sys.executable, "-m", "gapbridge", "run", str(cell), "--observe", "--duration", "2"],
            env=environment(), capture_output=True, text=True, timeout=PATIENCE, check=False,
        )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    rows = recorded(tmp_path)
    assert len(rows) > 200
    raw = np.array([[float(r[f"ft_raw_wrench_{i}"]) for i in range(3)] for r in rows])
    weight = np.linalg.norm(raw.mean(axis=0) - bias[:3])
    assert weight == pytest.approx(MASS * 9.80665, abs=0.15)


@pytest.mark.slow
def test_a_run_without_the_sensor_reports_which_and_ends(tmp_path: Path) -> None:
    with_sensor = cell_in(tmp_path, "robotous_rft")
    text = with_sensor.read_text(encoding="utf-8")
    elsewhere = tmp_path / "elsewhere.yaml"
    elsewhere.write_text(text.replace("interface: socketcand", "interface: socketcand, port: 9"))
    with simulated(with_sensor):
        done = subprocess.run(
            [sys.executable, "-m", "gapbridge", "run", str(elsewhere), "--observe",
             "--duration", "5"],
            env=environment(), capture_output=True, text=True, timeout=PATIENCE, check=False,
        )  # fmt: skip
    assert done.returncode == 1, done.stdout + done.stderr
    (line,) = done.stderr.strip().splitlines()
    assert "socketcand can0@" in line and ":9: cannot be reached" in line


@pytest.mark.parametrize(
    ("section", "phrase"),
    [
        ("driver: bota", "ft_sensor.driver"),
        ("rate: 100", "expected a key 'driver'"),
        ("driver: robotous_rft, reply_ids: [1, 1]", "ft_sensor.reply_ids"),
        ("driver: robotous_rft, chanel: can1", "did you mean 'channel'"),
        ("driver: ati_netcanoem, max_age: 0", "ft_sensor.max_age"),
        ("driver: robotiq_ft300, mode: fast", "'stream' or 'registers'"),
        ("driver: robotous_rft, interface: candy", "socketcan"),
        ("driver: robotous_rft, sensor_in_flange: {xyz: [0, 0]}", "sensor_in_flange"),
    ],
)
def test_a_section_that_cannot_be_is_one_clear_line(
    tmp_path: Path, section: str, phrase: str
) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(f"robot: {{model: ur10e}}\nft_sensor: {{{section}}}\n", encoding="utf-8")
    with pytest.raises(InputError) as reported:
        load_cell(path)
    message = str(reported.value)
    assert phrase in message and "line 2" in message and "\n" not in message


@pytest.mark.parametrize("name", ["ur10e_ft_robotous.yaml", "ur10e_ft300.yaml"])
def test_ready_cells_are_read(name: str) -> None:
    cell = load_cell(ROOT / "config" / name)
    assert cell.ft_sensor is not None and not cell.warnings


def test_a_sensor_that_no_other_process_can_reach_is_not_simulated(tmp_path: Path) -> None:
    cell = cell_in(tmp_path, "robotous_rft")
    text = cell.read_text(encoding="utf-8").replace("socketcand", "virtual")
    cell.write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "gapbridge", "simulate", str(cell)], env=environment(),
        capture_output=True, text=True, timeout=PATIENCE, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert "ft_sensor.interface: found 'virtual', expected socketcand" in done.stderr


@pytest.mark.parametrize("leads_to", ["device", "nowhere"])
def test_somebody_elses_link_to_a_serial_line_is_not_replaced(
    tmp_path: Path, leads_to: str
) -> None:
    """As /dev/serial/by-id/..., which leads to the real sensor; also with the plug pulled."""
    (tmp_path / "device").write_text("the real one")
    port = tmp_path / "by-id"
    port.symlink_to(tmp_path / leads_to)
    settings = RobotiqSettings(driver="robotiq_ft300", port=str(port))
    with (
        pytest.raises(InputError, match="by-id, expected a name that is free"),
        served_sensor(settings, lambda: (0.0,) * 6, SYSTEM),
    ):
        pass
    assert port.readlink() == tmp_path / leads_to


def test_the_link_of_a_simulation_that_was_killed_is_replaced(tmp_path: Path) -> None:
    port = tmp_path / "ft300"
    port.symlink_to("/dev/pts/99999")
    settings = RobotiqSettings(driver="robotiq_ft300", port=str(port))
    with served_sensor(settings, lambda: (0.0,) * 6, SYSTEM):
        assert port.exists()
    assert not port.is_symlink()
