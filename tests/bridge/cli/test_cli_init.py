"""``gapbridge init`` over CAN, CANopen and Modbus: the cell it writes passes check and observes."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from cli_runs import gapbridge, refused
from patience import PATIENCE
from ports import free_port, own_host

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.document import parse
from gapbridge.bridge.cell.first_cell import InitOptions, first_cell_text
from gapbridge.drivers.controller_facts import ControllerFacts

CONFIG = Path(__file__).parents[3] / "config"
PIPER = ("--driver", "can", "--profile", "piper", "--urdf", CONFIG / "piper.urdf", "--tip", "link6")
ODRIVE = ("--driver", "can", "--profile", "odrive", "--model", "ur10e")
LWA4P = ("--driver", "canopen", "--profile", "lwa4p", "--urdf", CONFIG / "lwa4p_canopen.urdf")
MODBUS = ("--driver", "modbus", "--profile", "ur", "--model", "ur10e")
GEARS = ("--link", "gear=[50, 50, 50, 20, 20, 20]", "--link", "direction=[1, 1, -1, 1, -1, 1]")


@contextlib.contextmanager
def simulated(folder: Path, config: str, **link: object) -> Iterator[str]:
    """Serve the arm of a cell in config/; yield its host."""
    host = own_host()
    cell = yaml.safe_load((CONFIG / config).read_text())
    cell["link"] |= {"host": host, **link}
    cell["recording"] = {"folder": str(folder / "recordings")}
    if "urdf" in cell["robot"]:
        cell["robot"]["urdf"] = str(CONFIG / cell["robot"]["urdf"])
    path = folder / "simulated.yaml"
    path.write_text(yaml.safe_dump(cell), encoding="utf-8")
    served = subprocess.Popen(
        [sys.executable, "-m", "gapbridge", "simulate", str(path)],
        stdout=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
    )  # fmt: skip
    try:
        assert served.stdout is not None
        for line in served.stdout:
            if line.startswith("ready"):
                break
        yield host
    finally:
        served.terminate()
        served.communicate(timeout=PATIENCE)


def init_check_and_observe(folder: Path, *arguments: object) -> Path:
    """Return the cell that init writes, after check --live and run --observe have taken it."""
    path = folder / "cell.yaml"
    answer = gapbridge("init", *arguments, "--out", path)
    assert answer.code == 0, answer.err
    assert "not reported: model" in answer.out
    assert gapbridge("check", path, "--live").code == 0
    answer = gapbridge("run", path, "--observe", "--duration", "0.5")
    assert answer.code == 0, answer.err
    assert "setpoints written 0" in answer.out
    return path


@pytest.mark.slow
def test_an_arm_on_a_socketcand_server(tmp_path: Path) -> None:
    port = free_port()
    with simulated(tmp_path, "piper_can_simulated.yaml", port=port) as host:
        path = init_check_and_observe(tmp_path, host, *PIPER, "--port", port)
    assert load_cell(path).file.robot.tip == "link6"


@pytest.mark.slow
def test_an_arm_on_an_slcan_adapter(tmp_path: Path) -> None:
    line = tmp_path / "tty"
    with simulated(tmp_path, "piper_can_simulated.yaml", interface="slcan", channel=str(line)):
        init_check_and_observe(tmp_path, line, *PIPER)


@pytest.mark.slow
def test_cia_402_drives(tmp_path: Path) -> None:
    port = free_port()
    with simulated(tmp_path, "lwa4p_canopen_simulated.yaml", port=port) as host:
        init_check_and_observe(tmp_path, host, *LWA4P, "--port", port)


@pytest.mark.slow
def test_a_modbus_controller(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port, work = free_port(), tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    with simulated(tmp_path, "ur10e_modbus_simulated.yaml", port=port) as host:
        keys = ("--port", port, "--link", "authority=ca.pem")
        path = init_check_and_observe(tmp_path, host, *MODBUS, *keys)
    assert load_cell(path).file.link.authority == Path("work/ca.pem")  # from the cell's folder


@pytest.mark.slow
def test_gears_that_only_the_builder_knows(tmp_path: Path) -> None:
    port = free_port()
    with simulated(tmp_path, "odrive_can_simulated.yaml", port=port) as host:
        given = (host, *ODRIVE, "--port", port)
        line = refused("init", *given, "--out", tmp_path / "cell.yaml")
        assert "--model ur10e: actual_q_1: found -15" in line
        assert "--link sets gear, zero, direction" in line
        path = init_check_and_observe(tmp_path, *given, *GEARS)
    assert load_cell(path).file.link.gear == (50, 50, 50, 20, 20, 20)


def test_a_profile_beside_the_cell_is_found_from_its_folder(tmp_path: Path) -> None:
    from gapbridge.bridge.cli.cell.init import _path_from_cell

    assert _path_from_cell(tmp_path / "arm.yaml", tmp_path / "cell.yaml") == "arm.yaml"
    assert _path_from_cell(tmp_path / "arm.yaml", tmp_path / "cells" / "c.yaml") == str(
        tmp_path / "arm.yaml"
    )


@pytest.mark.parametrize(
    ("arguments", "phrase"),
    [
        ((*ODRIVE, "--link", "geer=3"), "link.geer: found an unknown key 'geer' in link"),
        ((*ODRIVE, "--link", "gear=3"), "link.gear: found 3, expected a list"),
        ((*ODRIVE, "--link", "gear"), "--link: found 'gear', expected KEY=VALUE"),
        ((*ODRIVE, "--link", "gear=[50"), "--link, line 1: found broken YAML"),
        (("--port", "30004"), "--port: found with --driver ur_rtde"),
        (("--profile", "ur"), "--profile: found with --driver ur_rtde"),
        (("--link", "host=10.1.2.3"), "--link: found host, expected it once"),
        ((*ODRIVE, "--link", "profile=piper"), "--link: found profile, expected it once"),
        (("--tip", "tool0"), "--tip: found without --urdf"),
    ],
)
def test_a_key_of_the_link_that_is_none_is_refused(
    tmp_path: Path, arguments: tuple[object, ...], phrase: str
) -> None:
    assert phrase in refused("init", "127.9.9.9", *arguments, "--out", tmp_path / "new.yaml")


def test_a_host_that_sockets_cannot_look_up_is_refused(tmp_path: Path) -> None:
    line = refused("init", "192.168.0..10", "--out", tmp_path / "new.yaml")
    assert line.startswith("error: link.host: found '192.168.0..10', expected an IP address")


@pytest.mark.parametrize(
    ("host", "driver", "where"),
    [
        ("can0", "can", {"interface": "socketcan", "channel": "can0"}),
        ("slcan1", "canopen", {"interface": "socketcan", "channel": "slcan1"}),
        ("gateway", "can", {"interface": "socketcand", "host": "gateway"}),
        ("/dev/ttyACM0", "can", {"interface": "slcan", "channel": "/dev/ttyACM0"}),
        ("/dev/ttyUSB0", "modbus", {"transport": "rtu", "serial": "/dev/ttyUSB0"}),
        ("gateway", "modbus", {"host": "gateway"}),
    ],
)
def test_host_is_an_interface_a_serial_port_or_an_address(
    host: str, driver: str, where: dict[str, str]
) -> None:
    from gapbridge.bridge.cli.cell.init import _link

    found = _link(host, driver, "arm", None)
    assert found == {"driver": driver, "profile": "arm", **where}


@pytest.mark.parametrize(
    ("option", "value", "phrase"),
    [("--urdf", "none.urdf", "file not found"), ("--model", "ur99", "found 'ur99'")],
)
def test_the_arm_is_looked_at_before_the_controller_is_reached(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: str, value: str, phrase: str
) -> None:
    def reached(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr("gapbridge.bridge.cli.cell.init.enquire", reached)
    assert phrase in refused("init", "127.0.0.1", option, value, "--out", tmp_path / "new.yaml")


def test_a_calibrated_cell_replaces_no_log(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    (tmp_path / "log.csv").write_text("a\n1\n")
    cell.write_text("robot: {model: ur10e}\n")
    line = refused("calibrate", cell, "--apply", tmp_path / "log.csv")
    assert "log.csv: found .csv, expected .yaml or .yml" in line


def test_names_that_yaml_reads_otherwise_are_quoted() -> None:
    link = {"driver": "can", "profile": "cell #2.yaml", "channel": "1e5", "options": {"a": None}}
    options = InitOptions(link, urdf="arm #2: left.urdf", tip="yes")
    data = parse(first_cell_text(ControllerFacts(n=6), options), Path("cell.yaml")).data
    assert data["robot"] == {"urdf": "arm #2: left.urdf", "tip": "yes"}
    assert data["link"] == link
