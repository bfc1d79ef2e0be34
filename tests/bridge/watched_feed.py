"""A daemon's half without a robot: shared memory that fills, events, and a side process on it."""

from __future__ import annotations

import hashlib
import math
import subprocess
import threading
import time
from pathlib import Path
from typing import Any, Self

import httpx
import numpy as np
from numpy.typing import NDArray
from patience import PATIENCE
from ports import free_port

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import Phase, SharedMemory
from gapbridge.bridge.ipc.side_process import SideProcess
from gapbridge.drivers.clock import SYSTEM

Array = NDArray[np.float64]
N, RATE = 6, 125.0
CELL = """robot: {model: ur10e}
tool: {tcp: {xyz: [0, 0, 0.18]}}
payload: {mass: 5.0, cog: [0, 0, 0.06]}
compliance: {axial: [1e-6, 3e-6, 4e-6, 1e-5, 1e-5, 1e-5], radial: [1e-7, 1e-7, 1e-7, 0, 0, 0]}
link: {host: 127.0.0.2}
"""
HOME = np.array([0.3, -1.4, 1.9, -1.2, -1.57, 0.2])


class Feed:
    """``section``: web or metrics, with its keys; the rest of a daemon is imitated."""

    def __init__(
        self, folder: Path, section: str, session: str = "run-20260101-120000", **keys: Any
    ) -> None:
        self.port = keys.setdefault("port", free_port())
        cell = folder / "ur10e_press.yaml"
        cell.write_text(CELL)
        self._hand = load_cell(cell).model.without_terms()
        self.settings = DaemonSettings.model_validate(
            {
                "cell": cell, "link": {"driver": "ur_rtde", "host": "127.0.0.2", "rate": RATE},
                section: keys,
            }
        )  # fmt: skip
        self.section, self.session = section, session
        self.folder = folder
        scheme = "https" if keys.get("certificate") else "http"
        self.url = f"{scheme}://127.0.0.1:{self.port}/"
        self.memory = SharedMemory(N, clock=SYSTEM)
        self.state = State.OBSERVING
        self.restarts = 0
        self.counts: dict[str, int] = {"late": 1, "stale": 2, "overrun": 0}
        self._sequence = 0
        self.hash = hashlib.sha256(CELL.encode()).hexdigest()
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self.side: SideProcess | None = None
        self.log = (folder / f"{section}.log").open("ab")

    # -- life -------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        order = {
            "settings": self.settings.model_dump(mode="json"), "n": N, "session": self.session,
            "extra": {"text": CELL},
        }  # fmt: skip
        self.side = SideProcess(f"bridge.{self.section}.main", order, self.memory, SYSTEM, self.log)
        self.memory.enter(Phase.RUNNING)
        self.memory.note_state(self.state)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        assert self.side is not None
        self.side.close()
        self.memory.close()
        self.log.close()

    def wait(self, path: str = "", **keys: Any) -> httpx.Response:
        """Return the first answer that the process gives."""
        until = time.monotonic() + PATIENCE
        while True:
            try:
                return httpx.get(self.url + path, timeout=PATIENCE, **keys)
            except httpx.TransportError:
                phrase = (self.folder / f"{self.section}.log").read_text()
                assert time.monotonic() < until, f"{self.section} does not answer: {phrase}"
                time.sleep(0.05)

    # -- what a daemon does -----------------------------------------------------------------------

    def emit(self, **event: Any) -> None:
        with self._lock:
            self._sequence += 1
            assert self.side is not None
            self.side.emit(
                {
                    "time": time.time(), "monotonic": time.monotonic(),
                    "sequence": self._sequence, **event,
                }
            )  # fmt: skip

    def change(self, to: State, cause: str, detail: str = "") -> None:
        """Go into a state as the loop does."""
        before, self.state = self.state, to
        self.memory.note_state(to)
        self.emit(kind="transition", **{"from": before.name, "to": to.name}, cause=cause,
                  detail=detail)  # fmt: skip

    def change_cell(self, keys: str, ok: bool = True) -> None:
        """Write the cell file anew and report that it was taken, or not."""
        text = CELL + keys
        self.settings.cell.write_text(text)
        hashed = hashlib.sha256(text.encode()).hexdigest()
        self.hash = hashed if ok else self.hash
        self.emit(kind="configuration", ok=ok, hash=self.hash, detail="the cell was read again")

    def status(self) -> dict[str, Any]:
        return {
            "kind": "status", "schema": "gapbridge.status/1", "session": self.session,
            "cell": "ur10e_press", "pid": 4242, "configuration_hash": self.hash,
            "state": self.state.name.lower(), "since": time.time(), "why": "connected",
            "armed_by": "operator", "latched": "", "loop": {"pid": 4243, "restarts": self.restarts},
            "link": {
                "age": 0.004, "rate_hz": RATE, "cycles": self.memory.written, "missed": 3,
                "late": 1, "written": 0, "dropped": {"stale": 2, "not finite": 1},
            },
            "sides": {
                "recorder": {"pid": 4244, "restarts": 0}, "web": {"pid": 4245, "restarts": 0},
            },
            "counts": self.counts, "recording": "recordings/run-20260101-120000",
            "lost_rows": 7,
        }  # fmt: skip

    def _run(self) -> None:
        rng = np.random.default_rng(5)
        reported = 0.0
        begun = time.monotonic()
        due, number = begun, 0
        while not self._stop.is_set():
            self.row(number, due - begun, rng)
            number += 1
            if due - reported > 0.5:
                reported = due
                assert self.side is not None
                with self._lock:
                    self.side.emit({"time": time.time(), **self.status()})
            due += 1.0 / RATE
            time.sleep(max(due - time.monotonic(), 0.0))

    def row(self, number: int, t: float, rng: np.random.Generator) -> None:
        """Write one cycle: an arm that swings, and an offset that goes with it."""
        s, row = self.memory.slices, self.memory.next_row()
        writing = self.state in (State.COMPENSATING, State.HOLDING)
        q = HOME + 0.35 * np.sin(0.5 * t + np.arange(N))
        row[1:] = 0.0
        row[s["timestamp"]] = t
        row[s["state"]] = self.state
        row[s["written"]] = writing
        row[s["missed"]] = number % 400 == 399
        row[s["age"]] = 4e-4 * rng.lognormal(0.0, 0.3) + (9e-3 if number % 300 == 299 else 0.0)
        row[s["duration"]] = 1.1e-4 * rng.lognormal(0.0, 0.25)
        row[s["clamped"]] = 2 if writing and number % 50 == 0 else 0
        for name in ("actual_q", "target_q", "nominal_q", "corrected_q"):
            row[s[name]] = q
        row[s["payload"]] = 5.0
        row[s["payload_cog"]] = (0.0, 0.0, 0.06)
        row[s["joint_temperatures"]] = 27.0
        pull = np.array([12 * math.sin(0.9 * t), 6 * math.cos(0.7 * t), -8.0, 0.3, 0.0, 0.1])
        row[s["actual_TCP_force"]] = pull
        row[s["ft_raw_wrench"]] = self.wrench(q, pull) + rng.normal(0, [0.8] * 3 + [0.05] * 3)
        size = 1e-3 * np.array([0.5, -0.35, -1.1]) * (1 + 0.3 * np.sin(0.5 * t + np.arange(3)))
        row[s["offset"]] = [*size, *(0.8e-3 * np.sin(0.4 * t + np.arange(3)))]
        row[s["received"]] = time.monotonic() - 2e-4
        row[s["rate"]] = RATE
        row[s["robot_mode"]], row[s["safety_mode"]] = 7, 1
        self.memory.beat()
        self.memory.publish()

    def wrench(self, q: Array, pull: Array) -> Array:
        """Return what a flange sensor reads that carries 0.4 kg more than is declared."""
        force = self._hand.predict(q[None]).rotation[0].T @ (
            (5.4 * np.array([0, 0, -9.80665])) + pull[:3]
        )
        return np.array([*force, *np.cross([0, 0, 0.06], force)])


def self_signed(folder: Path) -> tuple[Path, Path]:
    """Return certificate and key of 127.0.0.1, valid for a day."""
    certificate, key = folder / "certificate.pem", folder / "key.pem"
    subprocess.run(
        [
            "openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
            "-nodes", "-days", "1", "-subj", "/CN=127.0.0.1",
            "-addext", "subjectAltName=IP:127.0.0.1",
            "-keyout", key, "-out", certificate,
        ],
        check=True, capture_output=True,
    )  # fmt: skip
    return certificate, key
