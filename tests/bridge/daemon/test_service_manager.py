"""What the service manager is notified of, and the unit that it runs."""

from __future__ import annotations

import configparser
import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from daemon_cell import Robot, gapbridge
from patience import PATIENCE, wait_for

from gapbridge.bridge.daemon.service_manager import ServiceManager
from gapbridge.drivers.clock import SYSTEM, Clock

UNIT = Path(__file__).parents[3] / "config" / "gapbridge@.service"


class Listener:
    """A socket such as systemd's, and what came through it."""

    def __init__(self, path: str) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.bind(path)
        self.socket.setblocking(False)
        self.lines: list[str] = []

    def take(self) -> list[str]:
        while True:
            try:
                self.lines += self.socket.recv(4096).decode().splitlines()
            except BlockingIOError:
                return self.lines


@pytest.fixture
def listener(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Listener]:
    path = str(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", path)
    found = Listener(path)
    yield found
    found.socket.close()


def test_signs_of_life_come_thrice_in_the_time_allowed(
    listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "300000")
    clock, ticks = Clock(), (1000.0 + 0.001 * k for k in range(900))
    clock.monotonic = lambda: next(ticks)
    manager = ServiceManager(clock)
    for _ in range(900):
        manager.kick()
    assert listener.take().count("WATCHDOG=1") == 9


def test_without_a_service_manager_or_with_a_dead_one_nothing_happens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert not ServiceManager(SYSTEM).present
    ServiceManager(SYSTEM).ready()
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    ServiceManager(SYSTEM).ready()


def test_an_abstract_socket_is_reached_too(monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"gapbridge-test-{os.getpid()}"
    listener = Listener(f"\0{name}")
    monkeypatch.setenv("NOTIFY_SOCKET", f"@{name}")
    ServiceManager(SYSTEM).stopping()
    assert listener.take() == ["STOPPING=1"]
    listener.socket.close()


@pytest.mark.slow
def test_the_daemon_reports_ready_alive_reloading_and_stopping_in_this_order(
    listener: Listener, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("WATCHDOG_USEC", "900000")
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    with Robot(tmp_path) as robot:
        run = gapbridge("run", robot.cell(), folder=tmp_path)
        wait_for(lambda: "READY=1" in listener.take(), "ready")
        alive = listener.lines.count("WATCHDOG=1")
        wait_for(lambda: listener.take().count("WATCHDOG=1") > alive + 3, "signs of life")
        run.send_signal(signal.SIGHUP)
        wait_for(lambda: listener.take().count("READY=1") == 2, "ready again")
        assert "RELOADING=1" in listener.lines
        assert any(line.startswith("MONOTONIC_USEC=") for line in listener.lines)
        run.send_signal(signal.SIGTERM)
        out, err = run.communicate(timeout=PATIENCE)
    assert (run.returncode, err) == (0, "")
    reported = [
        line for line in listener.take() if line.split("=")[0] in ("READY", "RELOADING", "STOPPING")
    ]
    assert reported == ["READY=1", "RELOADING=1", "READY=1", "STOPPING=1"]
    assert "the cell file was read again" in out


@pytest.mark.slow
def test_a_daemon_that_stands_still_gives_no_sign_of_life(
    listener: Listener, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("WATCHDOG_USEC", "300000")
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    with Robot(tmp_path) as robot:
        run = gapbridge("run", robot.cell(), folder=tmp_path)
        wait_for(lambda: "READY=1" in listener.take(), "ready")
        run.send_signal(signal.SIGSTOP)
        wait_for(lambda: psutil.Process(run.pid).status() == psutil.STATUS_STOPPED, "the stop")
        before = len(listener.take())
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "alive"))
        alive, other = ServiceManager(SYSTEM), Listener(str(tmp_path / "alive"))

        def lived() -> bool:
            alive.kick()
            return len(other.take()) >= 10

        wait_for(lived, "ten signs of a process that does not stand still")
        other.socket.close()
        assert len(listener.take()) == before
        run.send_signal(signal.SIGCONT)
        run.send_signal(signal.SIGTERM)
        run.communicate(timeout=PATIENCE)


def test_the_unit_is_sandboxed_and_not_root() -> None:
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str  # type: ignore[assignment,method-assign]
    unit.read_string(UNIT.read_text())
    service = unit["Service"]
    assert service["Type"] == "notify"
    assert service["User"] not in ("", "root", "0")
    assert service["NoNewPrivileges"] == "yes"
    assert service["CapabilityBoundingSet"] == ""
    assert service["ProtectSystem"] == "strict"
    assert service["KillMode"] == "mixed"
    assert {"AF_CAN", "AF_INET", "AF_INET6"} <= {*service["RestrictAddressFamilies"].split()}
    assert service["Restart"] == "on-failure"  # a trajectory's end is none
    assert float(service["WatchdogSec"]) > 3


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path: Path) -> None:
    text = UNIT.read_text().replace("/opt/gapbridge/.venv/bin/gapbridge", "/bin/true")
    copy = tmp_path / "gapbridge@cell.service"
    copy.write_text(text)
    done = subprocess.run(
        ["systemd-analyze", "verify", str(copy)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
