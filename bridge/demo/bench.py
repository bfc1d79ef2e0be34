"""The test bench of the simulated cell: attach loads, move the arm, read the laser tracker."""

from __future__ import annotations

import socket
import threading
import time
from typing import Self

import numpy as np

from gapbridge.bridge.demo.poses import Load
from gapbridge.core.arrays import Array
from gapbridge.core.errors import LinkError
from gapbridge.drivers.simulated.ur.settings import BENCH_PORT, SCRIPT_PORT

READINGS_PERIOD = 0.01  # s between two readings of the tracker
MAX_MOVE_TIME = 20.0  # s
POLL_PERIOD = 0.25  # s between two checks whether the arm is at rest
MAX_STILL_MOTION = 1.5e-4  # m of the TCP between two checks of an arm at rest


class Bench:
    """One connection to the bench port of the simulated controller, for one thread."""

    def __init__(self, host: str, port: int) -> None:
        self._host = host
        self._socket = socket.create_connection((host, port), timeout=10)
        self._lines = self._socket.makefile("r")

    def request(self, line: str) -> str:
        """Send a command and return the answer. Raises LinkError where the bench refuses it."""
        try:
            self._socket.sendall(line.encode() + b"\n")
            answer = self._lines.readline().strip()
        except OSError as error:
            raise LinkError(f"bench of {self._host}: {error}") from error
        if not answer or answer.startswith("error"):
            raise LinkError(f"bench of {self._host}: {line}: found {answer or 'nothing'!r}")
        return answer

    def measure(self) -> Array:
        """Return one reading (7,): time (s), position (m), rotation vector (rad).

        The time is on the clock of the recorded states: this computer's monotonic clock where the
        controller sends no time.
        """
        reading = self._reading()
        reading[0] = time.monotonic()
        return reading

    def _reading(self) -> Array:
        """Return one reading (7,) with the controller's own time."""
        return np.array([float(v) for v in self.request("measure").split(",")])

    def attach(self, load: Load) -> None:
        """Attach a payload to the flange and apply the load's external wrench at the TCP."""
        numbers = " ".join(f"{v:.9g}" for v in (load.mass, *load.cog))
        self.request(f"payload {numbers}")
        self.request("wrench " + " ".join(f"{v:.9g}" for v in load.wrench))

    def move_to(self, q: Array, travel: float = 0.0) -> None:
        """Move the arm to ``q`` (n,), rad, by the robot's program, and wait until it is at rest.

        Checks begin after ``travel`` s, the least that the move takes. Raises LinkError where the
        arm is not at rest within MAX_MOVE_TIME.
        """
        self._start(q)
        time.sleep(travel)
        latest, before = time.monotonic() + MAX_MOVE_TIME, self.measure()
        while time.monotonic() < latest:
            time.sleep(POLL_PERIOD)
            now = self.measure()
            if np.linalg.norm(now[1:4] - before[1:4]) < MAX_STILL_MOTION:
                return
            before = now
        raise LinkError(f"the arm did not come to rest within {MAX_MOVE_TIME:g} s")

    def _start(self, q: Array) -> None:
        """Start a move of the robot's program to ``q`` (n,), rad."""
        self.request("move " + " ".join(f"{v:.9g}" for v in q))

    def close(self) -> None:
        """Close the connection."""
        self._lines.close()
        self._socket.close()


class UrBench(Bench):
    """The bench of a UR controller: moves and payloads are sent as URScript."""

    def __init__(self, host: str) -> None:
        super().__init__(host, BENCH_PORT)

    def measure(self) -> Array:
        """Return one reading (7,) with the controller's time; see Bench.measure."""
        return self._reading()

    def attach(self, load: Load) -> None:
        """Attach a load, and enter its mass and centre of gravity in the controller."""
        super().attach(load)
        cog = ",".join(f"{v:.9g}" for v in load.cog)
        self._run_script(f"def attach():\n  set_payload({load.mass:.9g}, [{cog}])\nend\n")

    def _start(self, q: Array) -> None:
        numbers = ",".join(f"{v:.9g}" for v in q)
        self._run_script(f"def go():\n  movej([{numbers}], a=1.0, v=0.7)\nend\n")

    def _run_script(self, program: str) -> None:
        """Run a short URScript program on the controller."""
        address = (self._host, SCRIPT_PORT)
        with socket.create_connection(address, timeout=10) as script:
            script.sendall(program.encode())
            time.sleep(0.1)


class Tracker(threading.Thread):
    """Reads the tracker at 100 Hz while the ``with`` block lasts."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(name="tracker", daemon=True)
        self._bench = bench
        self._over = threading.Event()
        self._readings: list[Array] = []
        self._error: LinkError | None = None

    def run(self) -> None:
        """Collect readings until the ``with`` block ends."""
        try:
            while not self._over.wait(READINGS_PERIOD):
                self._readings.append(self._bench.measure())
        except LinkError as error:
            self._error = error

    def readings(self) -> Array:
        """Return all readings (N, 7); raises LinkError where the tracker failed."""
        if self._error is not None:
            raise self._error
        return np.array(self._readings).reshape(-1, 7)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self.join(5)
        self._bench.close()
