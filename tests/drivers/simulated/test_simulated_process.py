from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
from rtde_client import RtdeClient
from simulated_cell import cell_settings, own_address

from gapbridge.core.errors import LinkError
from gapbridge.drivers.simulated.ur.process import SimulatedController
from gapbridge.drivers.simulated.ur.settings import from_json, to_json

ROOT = Path(__file__).parents[3]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_command_serves_until_a_signal_and_exits_with_zero(number: signal.Signals) -> None:
    host = own_address()
    process = subprocess.Popen(
        [sys.executable, "-m", "gapbridge.drivers.simulated",
         "--arm", "ur3e", "--host", host, "--seed", "4"],
        stdout=subprocess.PIPE, text=True, cwd=ROOT,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == f"ready {host}\n"
    RtdeClient(host).close()
    process.send_signal(number)
    assert process.wait(5) == 0
    process.stdout.close()


def test_an_unknown_arm_is_bad_input_reported_in_one_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "gapbridge.drivers.simulated",
         "--arm", "ur10f", "--host", own_address()],
        capture_output=True, text=True, cwd=ROOT, timeout=20, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "found 'ur10f'" in done.stderr


def test_a_taken_port_is_reported_and_nothing_is_left_running() -> None:
    settings = cell_settings()
    with (
        SimulatedController(settings),
        pytest.raises(LinkError, match=f"{settings.host}: Address already in use"),
        SimulatedController(settings),
    ):
        pass


def test_the_server_listens_on_its_own_address_only() -> None:
    settings = cell_settings()
    other = own_address()
    with SimulatedController(settings):
        for port in (30004, 29999, 30003, 30100):
            with socket.create_connection((settings.host, port), timeout=5):
                pass
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection((other, port), timeout=5)


def test_the_server_ends_with_its_parent() -> None:
    settings = cell_settings()
    code = (
        "import json, sys, os\n"
        "from gapbridge.drivers.simulated.ur.process import SimulatedController\n"
        "from gapbridge.drivers.simulated.ur.settings import from_json\n"
        "c = SimulatedController(from_json(json.loads(sys.stdin.read())))\n"
        "c.start()\nprint(c.pid, flush=True)\nos.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], input=json.dumps(to_json(settings)),
        capture_output=True, text=True, cwd=ROOT, timeout=30, check=False,
    )  # fmt: skip
    pid = int(done.stdout)
    end = time.monotonic() + 5.0
    while time.monotonic() < end:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return
        state = Path(f"/proc/{pid}/stat").read_text().split()[2] if Path("/proc").exists() else ""
        if state == "Z":
            return
        time.sleep(0.02)
    pytest.fail("the server outlives its parent")


def test_settings_survive_the_way_to_another_process() -> None:
    settings = cell_settings(seed=11, arm="ur3", payload_mass=1.5)
    assert from_json(json.loads(json.dumps(to_json(settings)))) == settings


def test_the_clock_keeps_five_hundred_hertz() -> None:
    settings = cell_settings()
    with SimulatedController(settings):
        client = RtdeClient(settings.host)
        client.outputs("timestamp,actual_q,actual_TCP_force")
        client.start()
        client.sample()
        arrivals = []
        for _ in range(1500):
            client.sample()
            arrivals.append(time.monotonic())
    periods = sorted(b - a for a, b in pairwise(arrivals))
    assert periods[len(periods) // 2] == pytest.approx(0.002, abs=2e-4)
    assert arrivals[-1] - arrivals[0] == pytest.approx(1499 * 0.002, rel=0.02)
