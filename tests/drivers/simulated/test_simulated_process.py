from __future__ import annotations

import os
import pickle
import socket
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path

import pytest
from patience import PATIENCE
from ports import own_host
from rtde_client import RtdeClient
from simulated_cell import cell_settings
from simulated_controller import SimulatedController

from gapbridge.core.errors import LinkError


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
    other = own_host()
    with SimulatedController(settings):
        for port in (30004, 29999, 30003, 30100):
            with socket.create_connection((settings.host, port), timeout=5):
                pass
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection((other, port), timeout=5)


def test_the_server_ends_with_its_parent() -> None:
    settings = cell_settings()
    code = (
        "import os, pickle, sys\n"
        "from simulated_controller import SimulatedController\n"
        "c = SimulatedController(pickle.load(sys.stdin.buffer))\n"
        "c.start()\nprint(c.pid, flush=True)\nos.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], input=pickle.dumps(settings), capture_output=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}, timeout=PATIENCE, check=False,
    )  # fmt: skip
    pid = int(done.stdout)
    end = time.monotonic() + PATIENCE
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


@pytest.mark.realtime
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
