"""The whole daemon at 500 Hz on a simulated UR, while the page, the recorder and a scraper run.

What counts are the cycles that the loop missed, by its own counters, and how long its work took
from seeing a state to having written: the wire besides what ``setpoint.stream`` measures.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from numpy.typing import NDArray

from benchmarks.machine_stalls import MachineStalls, Missed
from gapbridge.bridge.demo.processes import ServedCell
from gapbridge.core.log.mcap_reading import SUFFIX, read_columns
from gapbridge.drivers.simulated.ur.settings import simulated_cell

HOST, RATE, SEED = "127.78.0.5", 500.0, 11
WARM_UP = 5.0  # s of compensating before anything is counted
PATIENCE = 240.0  # s until the daemon compensates
PAYLOAD, COG = 5.0, (0.0, 0.0, 0.06)
LOG = "daemon.log"
EVERY = 1.0  # s between two scrapes, and two looks at the status
TIMES = "advance.f64"
TIMED = 1 << 19  # setpoints at the most: 17 minutes


def loop(seconds: float) -> dict[str, Any]:
    """Return the row of the daemon's loop: ``seconds`` of compensating, and as many once more.

    In the first a bare timer on each processor shows what the machine takes from everybody. Those
    timers come between, a thousand times a second: single setpoints are timed in the second.
    """
    with tempfile.TemporaryDirectory(prefix="loop-") as folder:
        times, cores = Path(folder) / TIMES, os.sched_getaffinity(0)
        with _beside_the_loop(), _served(Path(folder)) as (web, metrics, cell):
            _compensating(web, cell)
            with _page(web):
                with MachineStalls(cores) as stalls:
                    counted = _counted(web, metrics, seconds)
                _compensating(web, cell)
                time.sleep(WARM_UP)
                first = len(_timed(times))
                time.sleep(seconds)
                advance = _timed(times)[first:]
        span = counted["begin"], counted["begin"] + counted["took"]
        own = stalls.not_among(_missed(Path(folder) / "recordings", *span), 1 / RATE)
    work, cycles, missed = counted["work"], counted["cycles"], counted["missed_cycles"]
    middle, most, far = np.percentile(advance[:, 0], [50, 99, 99.9]).tolist()
    whole = max(cycles + missed, 1.0)
    return {
        "row": f"the daemon at {RATE:g} Hz with page, recorder and scraper, {seconds:.0f} s",
        "goal": "under 0.2 % missed; SetpointStream.advance p99 under 50 us",
        "sides": {
            "SetpointStream.advance in that loop": {
                "wall_s": {"median": middle, "p99": most, "p99_9": far},
                "cpu_s": {"median": float(np.median(advance[:, 1]))},
            },
            "loop, from seeing a state to having written": {
                "wall_s": {"median": work["p50"], "p99": work["p99"]},
                "cpu_s": {"median": counted["busy"] / max(cycles, 1.0)},
            }
        },
        "ratios": [], "state": counted["state"], "setpoints_timed": len(advance),
        "cycles": int(cycles), "missed_cycles": int(missed),
        "late_cycles": int(counted["late_cycles"]), "missed_percent": 100.0 * missed / whole,
        "missed_percent_while_bare_timers_were_on_time": None if stalls.spans is None else
        100.0 * sum(count for _, count in own) / whole,
        "age_p99_s": counted["age_p99_s"], "recorder_lost": counted["recorder_lost"],
    }  # fmt: skip


def _counted(web: str, metrics: str, seconds: float) -> dict[str, Any]:
    """Return what the daemon counted over ``seconds``, scraped and looked at all the while."""
    time.sleep(WARM_UP)
    before, status = _counters(metrics), _status(web)
    process = psutil.Process(status["status"]["loop"]["pid"])
    busy, begin = _busy(process), time.monotonic()
    while time.monotonic() < begin + seconds:
        time.sleep(EVERY)
        after, status = _counters(metrics), _status(web)
    return {
        "begin": begin, "took": time.monotonic() - begin, "busy": _busy(process) - busy,
        **{name: after[name] - before[name] for name in ("cycles", "missed_cycles", "late_cycles")},
        "work": status["timing"]["duration"], "age_p99_s": status["timing"]["age"]["p99"],
        "state": status["now"]["state"], "recorder_lost": after["recorder_lost_cycles"],
    }  # fmt: skip


def _timed(path: Path) -> NDArray[np.float64]:
    """Return wall and CPU time (N, 2) of the setpoints so far, s."""
    times = np.fromfile(path).reshape(-1, 2)
    return times[times[:, 0] > 0.0]


def _missed(folder: Path, begin: float, end: float) -> list[Missed]:
    """Return the cycles that a recorded run missed between two moments (s, monotonic)."""
    found: list[Missed] = []
    for file in sorted(folder.rglob(f"*{SUFFIX}")):
        columns = read_columns(file)
        seen, missed = columns["received"], columns["missed"]
        chosen = (begin < seen) & (seen < end) & (missed > 0)
        found += zip(seen[chosen].tolist(), missed[chosen].astype(int).tolist(), strict=True)
    return found


@contextmanager
def _beside_the_loop() -> Iterator[None]:
    """Keep this thread, and the robot that it starts, on part of the processors.

    A cell's robot has a computer of its own, and nobody scrapes from the cell's.
    """
    whole = os.sched_getaffinity(0)
    if len(whole) > 1:
        os.sched_setaffinity(0, whole - {max(whole)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, whole)


@contextmanager
def _served(folder: Path) -> Iterator[tuple[str, str, Path]]:
    """Yield the addresses of page and metrics of a daemon on a simulated robot, and its cell."""
    settings = simulated_cell(
        "ur10e", HOST, SEED, tcp=(0.0, 0.0, 0.18, 0.0, 0.0, 0.0), payload_mass=PAYLOAD,
        payload_cog=COG,
    )  # fmt: skip
    ports = [_free_port(), _free_port()]
    t = np.arange(0.0, 3600.0, 0.02)
    way = 0.009 * (1 - np.cos(0.6 * t))[:, None] * [1, 0.4, -0.6, 0.3, 0.5, 1.0]
    header = ",".join(["timestamp", *(f"target_q_{i}" for i in range(6))])
    rows = np.column_stack([t, np.array(settings.start_q) + way])
    np.savetxt(folder / "way.csv", rows, "%.9g", ",", header=header, comments="")
    cell = folder / "cell.yaml"
    cell.write_text(
        "robot: {model: ur10e}\n"
        "tool: {tcp: {xyz: [0, 0, 0.18], rpy: [0, 0, 0]}}\n"
        f"payload: {{mass: {PAYLOAD}, cog: {list(COG)}}}\n"
        f"compliance: {{axial: {list(settings.plant.axial)}, "
        f"radial: {list(settings.plant.radial)}}}\n"
        f"link: {{driver: ur_rtde, host: {HOST}, rate: {RATE:g}}}\n"
        "setpoints: {source: trajectory, file: way.csv}\n"
        f"web: {{port: {ports[0]}}}\nmetrics: {{port: {ports[1]}}}\n"
        "recording: {folder: recordings}\n",
        encoding="utf-8",
    )
    with ServedCell(cell, SEED), (folder / LOG).open("wb") as log:
        command = [sys.executable, "-m", "gapbridge", "run", str(cell), "--log", "json"]
        timing = Path(__file__).with_name("in_the_loop")
        path = os.pathsep.join([str(timing), *(p for p in sys.path if p)])
        times = folder / TIMES
        np.zeros((TIMED, 2)).tofile(times)
        named = {"PYTHONPATH": path, "ADVANCE_TIMES": str(times)}
        daemon = subprocess.Popen(
            command, stdout=log, stderr=log, env={**os.environ, **named},
            preexec_fn=lambda: os.sched_setaffinity(0, range(os.cpu_count() or 1)),
        )  # fmt: skip
        try:
            web, metrics = (f"http://127.0.0.1:{port}/" for port in ports)
            yield web, metrics + "metrics", cell
        finally:
            daemon.send_signal(signal.SIGTERM)
            try:
                daemon.wait(30)
            except subprocess.TimeoutExpired:
                daemon.kill()


@contextmanager
def _page(web: str) -> Iterator[None]:
    """Hold a page open: its stream of events is read as it comes."""
    link = urllib.request.urlopen(web + "events", timeout=30)
    over = threading.Event()

    def read() -> None:
        while not over.is_set() and link.readline():
            pass

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        yield
    finally:
        over.set()
        reader.join(5)


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def _status(web: str) -> dict[str, Any]:
    with urllib.request.urlopen(web + "status", timeout=10) as answer:
        found: dict[str, Any] = json.load(answer)
    return found


def _compensating(web: str, cell: Path) -> None:
    """Arm, as a person at the machine does, until setpoints are written. Raises TimeoutError."""
    until, state = time.monotonic() + PATIENCE, "no answer"
    while time.monotonic() < until:
        with suppress(OSError):
            state = str(_status(web).get("now", {}).get("state"))
        if state == "compensating":
            return
        # a fault that a busy machine made of the start is acknowledged
        if state != "no answer" and _command("arm", cell):
            _command("disarm", cell)
        time.sleep(1.0)
    last = cell.with_name(LOG).read_text(encoding="utf-8").splitlines()[-3:]
    raise TimeoutError(
        f"the daemon: found {state} after {PATIENCE:g} s, expected compensating: {last}"
    )


def _command(name: str, cell: Path) -> int:
    command = [sys.executable, "-m", "gapbridge", name, str(cell)]
    return subprocess.run(command, capture_output=True, check=False).returncode


def _counters(metrics: str) -> dict[str, float]:
    """Return the daemon's counters without their common beginning and end."""
    with urllib.request.urlopen(metrics, timeout=10) as answer:
        lines = answer.read().decode().splitlines()
    found = {}
    for line in lines:
        name, _, value = line.rpartition(" ")
        if name.startswith("gapbridge_") and name.endswith("_total"):
            found[name.removeprefix("gapbridge_").removesuffix("_total")] = float(value)
    return found


def _busy(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)
