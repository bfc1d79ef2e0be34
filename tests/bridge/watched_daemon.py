"""A whole daemon on a simulated robot, with page and metrics, in a process of its own."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from typing import Any

import httpx
import numpy as np
import psutil
from daemon_cell import Robot
from patience import PATIENCE, wait_for
from ports import free_port


class Watched:
    """``gapbridge run --log json`` in a process of its own, as a plant starts it.

    The way is within the start's tolerance (0.02 rad) everywhere: it can be armed again after a
    machine that was too busy.
    """

    def __init__(
        self, robot: Robot, *options: str, web: int | None = None, swing: float = 0.009
    ) -> None:
        self.web, self.metrics = web or free_port(), free_port()
        self.cell = robot.cell(
            ", rate: 125",
            web=f"{{port: {self.web}}}", metrics=f"{{port: {self.metrics}}}",
            setpoints="{source: trajectory, file: way.csv}",
        ).rename(robot.folder / "press_3.yaml")  # fmt: skip
        t = np.arange(0.0, 120.0, 0.02)
        way = swing * (1 - np.cos(0.6 * t))[:, None] * [1, 0.4, -0.6, 0.3, 0.5, 1.0]
        rows = np.column_stack([t, np.array(robot.settings.start_q) + way])
        header = ",".join(["timestamp", *(f"target_q_{i}" for i in range(6))])
        np.savetxt(robot.folder / "way.csv", rows, "%.9g", ",", header=header, comments="")
        self.log = robot.folder / "daemon.log"
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "gapbridge", "run", self.cell, "--log", "json", *options],
                stdout=subprocess.DEVNULL, stderr=log,
            )  # fmt: skip

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.web}/"

    def status(self) -> dict[str, Any]:
        try:
            found: dict[str, Any] = httpx.get(f"{self.url}status", timeout=PATIENCE).json()
        except httpx.TransportError:
            return {}
        return found

    def wait(self, state: str) -> None:
        def there() -> bool:
            assert self.process.poll() is None, self.log.read_text()
            return bool(self.status().get("now", {}).get("state") == state)

        wait_for(there, f"{state} ({self.log.read_text()[-2000:]})")

    def command(self, name: str) -> int:
        return subprocess.run([sys.executable, "-m", "gapbridge", name, self.cell]).returncode

    def arm(self) -> None:
        """Have a person at the machine arm; what a busy machine made of the link is cleared."""
        until = time.monotonic() + PATIENCE
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
            self.process.wait(PATIENCE)
        finally:
            self.process.kill()


def listening(pid: int) -> set[tuple[str, int]]:
    """Return where a process and all its children listen, TCP and UDP."""
    whole = psutil.Process(pid)
    found = set()
    for process in (whole, *whole.children(recursive=True)):
        for c in process.net_connections("inet"):
            if c.status == psutil.CONN_LISTEN or (c.type.name == "SOCK_DGRAM" and not c.raddr):
                found.add((c.laddr.ip, c.laddr.port))
    return found
