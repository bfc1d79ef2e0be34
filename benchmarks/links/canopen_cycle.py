"""What a cycle on CANopen costs beside the canopen library: ``-m benchmarks.links.canopen_cycle``.

A cycle of ours is SYNC, twelve TPDOs decoded and checked, compensation and six RPDOs; the bare
library sends the same six RPDOs (values put into its PdoVariables) and SYNC, waits for the same
TPDOs and reads the six positions. Both talk to the same simulated drives in another process, in
turns and at the same pace, and the medians are compared.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import canopen
import numpy as np

from bridge.cell import load_cell
from core.compensation import Compensator
from core.errors import LinkError
from core.setpoint import Setpoint
from drivers.can.bus import close_bus, open_bus
from drivers.canopen.driver import CanopenDriver
from drivers.canopen.settings import CanopenSettings

HOST, PORT = "127.77.0.3", 29920
ROUNDS, EACH = 5, 150
PACE = 0.006  # s from one cycle to the next
CELL = f"""\
robot: {{model: ur10e}}
payload: {{mass: 5.0, cog: [0.0, 0.0, 0.06]}}
compliance: {{axial: [3.0e-6, 4.0e-6, 5.0e-6, 9.0e-6, 1.2e-5, 1.5e-5]}}
link: {{driver: canopen, profile: cia402, interface: socketcand, host: {HOST}, port: {PORT},
  rate: 125, listen: 0.05, foreign_quiet: 0.1}}
"""


def ours(path: Path) -> list[float]:
    """Return the durations of our cycles, us."""
    cell = load_cell(path)
    link = cell.link
    assert isinstance(link, CanopenSettings)
    with CanopenDriver(link, cell.model) as driver:
        compensator = Compensator(cell.model)
        compensator.correct(driver.read_state().actual_q)  # compiled before drives wait for us
        driver.arm(driver.read_state())
        hold = driver.writer.target
        assert hold is not None

        def cycle() -> None:
            driver.rhythm._due = 0.0  # no pacing: the next SYNC is due at once
            state = driver.read_state()
            found = compensator.correct(hold)
            q = hold + 1e-3 * (found.q - hold)  # the same work, and the arm stays where it is
            driver.write_setpoint(
                Setpoint(q, hold, found.offset_in_base, state.timestamp, state.received)
            )

        return timed(cycle)


def library(path: Path) -> list[float]:
    """Return the durations of the library's cycles, us; our driver has set the drives up."""
    link = load_cell(path).link
    assert isinstance(link, CanopenSettings)
    driver = CanopenDriver(link, load_cell(path).model)
    profile, bus = driver.profile, open_bus(link)
    network: Any = canopen.Network(bus)
    network.NOTIFIER_CYCLE = 0.05
    network.connect()
    time.sleep(0.1)  # the simulated bus gives a newcomer no frames at once
    come, missing = threading.Event(), [0]

    def count(_: Any) -> None:
        missing[0] -= 1
        if missing[0] == 0:
            come.set()

    for node in profile.nodes:
        remote = network.add_node(node, profile.eds.dictionary(node))
        remote.tpdo.read()
        remote.rpdo.read()
        for layout in profile.tpdo:
            remote.tpdo[layout.number].add_callback(count)
        remote.nmt.state = "OPERATIONAL"
    pdos = [(network[node].rpdo[1], network[node].tpdo[1]) for node in profile.nodes]

    def cycle() -> None:
        for rpdo, _ in pdos:
            rpdo["Controlword"].raw = 0
            rpdo["Target position"].raw = 0
            rpdo.transmit()
        missing[0] = 12
        come.clear()
        network.sync.transmit()
        come.wait(0.05)
        for _, tpdo in pdos:
            _ = tpdo["Position actual value"].raw

    try:
        return timed(cycle)
    finally:
        network.disconnect()
        close_bus(bus)


def timed(call: Callable[[], None]) -> list[float]:
    """Return the durations of many calls, us; a torn set is none."""
    found = []
    due = time.perf_counter()
    for _ in range(EACH):
        due = max(due + PACE, time.perf_counter())
        time.sleep(max(due - time.perf_counter(), 0.0))
        begun = time.perf_counter()
        try:
            call()
        except LinkError:
            continue
        found.append(1e6 * (time.perf_counter() - begun))
    return found


def measure(path: Path) -> dict[str, float]:
    """Return medians and 99th percentiles of a cycle in us, ours and the library's."""
    times: dict[str, list[float]] = {"ours": [], "library": []}
    for _ in range(ROUNDS):
        times["ours"] += ours(path)
        times["library"] += library(path)
    found = {
        f"{name}_p{share}_us": round(float(np.percentile(values, share)), 1)
        for name, values in times.items()
        for share in (50, 99)
    }
    return {**found, "ratio": round(found["ours_p50_us"] / found["library_p50_us"], 2)}


def main() -> None:
    """Serve, measure, print one line of JSON."""
    sys.setswitchinterval(1e-4)  # as the loop's process has it
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        path.write_text(CELL, encoding="utf-8")
        served = subprocess.Popen(
            [sys.executable, "-m", "bridge.cli", "simulate", str(path)],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            assert served.stdout is not None
            while not served.stdout.readline().startswith("ready"):
                if served.poll() is not None:
                    raise SystemExit("the simulated drives did not start")
            print(json.dumps(measure(path)))
        finally:
            served.terminate()
            served.wait(5.0)


if __name__ == "__main__":
    main()
