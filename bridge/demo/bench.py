"""The people and the laser tracker around the simulated cell: its bench port, and the pendant."""

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
LONGEST_MOVE = 20.0  # s
LOOK = 0.25  # s between two looks at whether the arm stands
STANDING = 1.5e-4  # m between two looks


class Bench:
    """One connection to the bench port, for one thread."""

    def __init__(self, host: str, port: int) -> None:
        self._host = host
        self._socket = socket.create_connection((host, port), timeout=10)
        self._lines = self._socket.makefile("r")

    def ask(self, line: str) -> str:
        """Return the bench's answer; raises LinkError where it refuses."""
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

        The time is that of the run's states: this machine's, where a controller sends none.
        """
        reading = self._reading()
        reading[0] = time.monotonic()
        return reading

    def _reading(self) -> Array:
        """Return one reading (7,) with the controller's own time."""
        return np.array([float(v) for v in self.ask("measure").split(",")])

    def hang(self, load: Load) -> None:
        """Hang a load on the flange, and let go of the tool or pull at it."""
        numbers = " ".join(f"{v:.9g}" for v in (load.mass, *load.cog))
        self.ask(f"payload {numbers}")
        self.ask("wrench " + " ".join(f"{v:.9g}" for v in load.wrench))

    def go(self, q: Array, travel: float = 0.0) -> None:
        """Move the arm to ``q`` (n,) by its own program, and wait until it stands there.

        It is looked at from ``travel`` s on, which it takes at least. Raises LinkError where it
        does not come to rest in time.
        """
        self._start(q)
        time.sleep(travel)
        latest, before = time.monotonic() + LONGEST_MOVE, self.measure()
        while time.monotonic() < latest:
            time.sleep(LOOK)
            now = self.measure()
            if np.linalg.norm(now[1:4] - before[1:4]) < STANDING:
                return
            before = now
        raise LinkError(f"the arm did not come to rest within {LONGEST_MOVE:g} s")

    def _start(self, q: Array) -> None:
        """Have the robot's own program move to ``q`` (n,)."""
        self.ask("move " + " ".join(f"{v:.9g}" for v in q))

    def close(self) -> None:
        """Leave the bench."""
        self._lines.close()
        self._socket.close()


class UrBench(Bench):
    """The bench of a UR controller: people use its pendant, and its clock is everyone's."""

    def __init__(self, host: str) -> None:
        super().__init__(host, BENCH_PORT)

    def measure(self) -> Array:
        """Return one reading (7,), its time the controller's; see Bench.measure."""
        return self._reading()

    def hang(self, load: Load) -> None:
        """Hang a load as on any bench, and enter it in the controller."""
        super().hang(load)
        cog = ",".join(f"{v:.9g}" for v in load.cog)
        self._pendant(f"def hang():\n  set_payload({load.mass:.9g}, [{cog}])\nend\n")

    def _start(self, q: Array) -> None:
        numbers = ",".join(f"{v:.9g}" for v in q)
        self._pendant(f"def go():\n  movej([{numbers}], a=1.0, v=0.7)\nend\n")

    def _pendant(self, program: str) -> None:
        """Run a short program, as a person at the pendant would."""
        address = (self._host, SCRIPT_PORT)
        with socket.create_connection(address, timeout=10) as script:
            script.sendall(program.encode())
            time.sleep(0.1)


class Tracker(threading.Thread):
    """Reads the tracker a hundred times a second while the ``with`` block lasts."""

    def __init__(self, bench: Bench) -> None:
        super().__init__(name="tracker", daemon=True)
        self._bench = bench
        self._ending = threading.Event()
        self._readings: list[Array] = []
        self._error: LinkError | None = None

    def run(self) -> None:
        """Collect readings until the block ends."""
        try:
            while not self._ending.wait(READINGS_PERIOD):
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
        self._ending.set()
        self.join(5)
        self._bench.close()
