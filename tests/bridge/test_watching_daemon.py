"""A whole daemon on a simulated robot, watched: page, metrics, log; what it listens on."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import psutil
import pytest
from daemon_cell import Robot, wait_for
from watched_feed import free_port

pytestmark = pytest.mark.slow


class Watched:
    """``gapbridge run --log json`` in a process of its own, as a plant starts it."""

    def __init__(self, robot: Robot, *options: str, web: int | None = None) -> None:
        self.web, self.metrics = web or free_port(), free_port()
        self.cell = robot.cell(
            ", rate: 125",
            web=f"{{port: {self.web}}}", metrics=f"{{port: {self.metrics}}}",
            setpoints="{source: trajectory, file: way.csv}",
        )  # fmt: skip
        t = np.arange(0.0, 120.0, 0.02)
        way = 0.12 * (1 - np.cos(0.6 * t))[:, None] * [1, 0.4, -0.6, 0.3, 0.5, 1.0]
        rows = np.column_stack([t, np.array(robot.settings.start_q) + way])
        header = ",".join(["timestamp", *(f"target_q_{i}" for i in range(6))])
        np.savetxt(robot.folder / "way.csv", rows, "%.9g", ",", header=header, comments="")
        self.log = robot.folder / "daemon.log"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "bridge.cli", "run", self.cell, "--log", "json", *options],
                stdout=subprocess.DEVNULL, stderr=log,
            )  # fmt: skip

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.web}/"

    def status(self) -> dict[str, Any]:
        try:
            found: dict[str, Any] = httpx.get(f"{self.url}status", timeout=5).json()
        except httpx.TransportError:
            return {}
        return found

    def wait(self, state: str, limit: float = 60.0) -> None:
        def there() -> bool:
            assert self.process.poll() is None, self.log.read_text()
            return bool(self.status().get("now", {}).get("state") == state)

        wait_for(there, limit, f"{state} ({self.log.read_text()[-2000:]})")

    def command(self, name: str) -> int:
        return subprocess.run([sys.executable, "-m", "bridge.cli", name, self.cell]).returncode

    def arm(self) -> None:
        """Have a person at the machine arm; what a busy machine made of the link is cleared."""
        until = time.monotonic() + 60
        while self.status().get("now", {}).get("state") != "compensating":
            assert time.monotonic() < until, self.log.read_text()[-3000:]
            if self.command("arm"):
                self.command("disarm")
            time.sleep(1.5)

    def events(self) -> list[dict[str, Any]]:
        return [json.loads(line) for line in self.log.read_text().splitlines()]

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(20)
        finally:
            self.process.kill()


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    with Robot(tmp_path_factory.mktemp("watched")) as found:
        yield found


@pytest.fixture
def daemon(robot: Robot) -> Iterator[Watched]:
    found = Watched(robot)
    try:
        found.wait("observing")
        yield found
    finally:
        found.end()


def listening(pid: int) -> set[tuple[str, int]]:
    """Return where a process and all its children listen, TCP and UDP."""
    whole = psutil.Process(pid)
    found = set()
    for process in (whole, *whole.children(recursive=True)):
        for c in process.net_connections("inet"):
            if c.status == psutil.CONN_LISTEN or (c.type.name == "SOCK_DGRAM" and not c.raddr):
                found.add((c.laddr.ip, c.laddr.port))
    return found


def test_the_daemon_is_watched_and_nothing_about_it_can_be_changed_from_the_network(
    daemon: Watched,
) -> None:
    # a stranger's scan: page and metrics on loopback, and not one port more
    assert listening(daemon.process.pid) == {
        ("127.0.0.1", daemon.web), ("127.0.0.1", daemon.metrics),
    }  # fmt: skip
    for path in ("arm", "disarm", "stop", "status", "session"):
        for method in ("POST", "PUT"):
            assert httpx.request(method, daemon.url + path).status_code == 405
    assert daemon.status()["now"]["state"] == "observing"

    daemon.arm()
    found = daemon.status()
    assert found["now"]["written"] > 20
    assert 60 < found["now"]["rate"] < 150
    assert set(found["status"]["sides"]) == {"recorder", "web", "metrics"}
    history = httpx.get(f"{daemon.url}history?seconds=2&points=100").json()
    column = {name: i for i, name in enumerate(history["columns"])}
    last = history["points"][-1]
    assert 1e-5 < np.linalg.norm(last[2:8]) < 0.02
    assert last[column["measured_fz"]] is not None
    assert last[column["predicted_fz"]] == pytest.approx(last[column["measured_fz"]], abs=5.0)
    text = httpx.get(f"http://127.0.0.1:{daemon.metrics}/metrics").text
    assert 'gapbridge_transitions_total{cause="writing",to="compensating"}' in text

    daemon.command("disarm")
    daemon.wait("observing")
    daemon.end()
    events = daemon.events()
    assert all({"time", "level", "event", "message"} <= set(event) for event in events)
    told = [event["to"].lower() for event in events if event["event"] == "transition"]
    assert told[0] == "observing"
    assert told.index("armed") < told.index("compensating")
    assert "robot:" not in daemon.log.read_text()  # the cell's own text is in no log


def test_page_and_metrics_die_and_come_back_and_the_loop_never_notices(daemon: Watched) -> None:
    before = daemon.status()
    loop = before["status"]["loop"]["pid"]
    for name in ("web", "metrics"):
        os.kill(before["status"]["sides"][name]["pid"], signal.SIGKILL)

    def back() -> bool:
        status = daemon.status().get("status") or {}
        sides = status.get("sides", {})
        return bool(sides) and all(sides[n]["restarts"] == 1 for n in ("web", "metrics"))

    wait_for(back, 30.0, "page and metrics")
    after = daemon.status()
    assert after["status"]["loop"]["pid"] == loop
    assert after["status"]["loop"]["restarts"] == 0
    assert after["session"] == before["session"]
    assert listening(daemon.process.pid) == {
        ("127.0.0.1", daemon.web), ("127.0.0.1", daemon.metrics),
    }  # fmt: skip
