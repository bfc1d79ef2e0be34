"""What a cycle on Modbus costs beside pymodbus alone: ``python -m benchmarks.links.modbus_cycle``.

A cycle reads one block, decodes and checks it, takes the robot's own joints out of it, compensates
and writes a mailbox; the bare library reads the same block and writes the same registers. Both talk
to the same simulated UR10e in another process, in turns and at the same pace (without one, the
call that pauses less finds the server's processor awake), and the medians are compared.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from pymodbus.client import ModbusTcpClient

from bridge.cell import load_cell
from core.compensation import Compensator
from core.setpoint import Setpoint
from drivers.modbus.driver import ModbusDriver
from drivers.modbus.settings import ModbusSettings

HOST, PORT = "127.77.0.2", 15920
READ, COUNT, WRITE = 246, 80, 236  # what profile ur comes to
ROUNDS, EACH = 20, 60
PACE = 0.005  # s from one cycle to the next
CELL = f"""\
robot: {{model: ur10e}}
payload: {{mass: 5.0, cog: [0.0, 0.0, 0.06]}}
compliance: {{axial: [3.0e-6, 4.0e-6, 5.0e-6, 9.0e-6, 1.2e-5, 1.5e-5]}}
link: {{driver: modbus, profile: ur, host: {HOST}, port: {PORT}, rate: 500}}
"""


def measure(path: Path) -> dict[str, float]:
    """Return medians and 99th percentiles of a cycle in us, ours and the library's."""
    cell = load_cell(path)
    link = cell.link
    assert isinstance(link, ModbusSettings)
    with ModbusDriver(link, cell.model) as driver:
        for _ in range(5):
            state = driver.read_state()
        driver.arm(state)
        compensator = Compensator(cell.model)
        bare = ModbusTcpClient(HOST, port=PORT, timeout=0.1, retries=0)
        bare.connect()

        def ours() -> None:
            driver._due = 0.0  # no pacing: the next reading is due at once
            sample = driver._decoder.decode(driver._read_blocks())
            state = driver._believe(sample, time.monotonic())
            q = driver.nominal_q(state)
            found = compensator.correct(q)
            driver.write_setpoint(
                Setpoint(found.q, q, found.offset_in_base, state.timestamp, state.received)
            )

        def library() -> None:
            bare.read_holding_registers(READ, count=COUNT, device_id=1)
            bare.write_registers(WRITE, words, device_id=1)

        ours()
        words = driver._writer._words()  # type: ignore[attr-defined]
        times: dict[str, list[float]] = {"ours": [], "library": []}
        for _ in range(ROUNDS):
            times["ours"] += timed(ours)
            words = driver._writer._words()  # type: ignore[attr-defined]
            times["library"] += timed(library)
        bare.close()
    found = {
        f"{name}_p{share}_us": round(float(np.percentile(values, share)), 1)
        for name, values in times.items()
        for share in (50, 99)
    }
    return {**found, "ratio": round(found["ours_p50_us"] / found["library_p50_us"], 2)}


def timed(call: Callable[[], None]) -> list[float]:
    """Return the durations of many calls, us."""
    found = []
    due = time.perf_counter()
    for _ in range(EACH):
        due += PACE
        time.sleep(max(due - time.perf_counter(), 0.0))
        begun = time.perf_counter()
        call()
        found.append(1e6 * (time.perf_counter() - begun))
    return found


def main() -> None:
    """Serve, measure, print one line of JSON."""
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
                    raise SystemExit("the simulated controller did not start")
            print(json.dumps(measure(path)))
        finally:
            served.terminate()
            served.wait(5.0)


if __name__ == "__main__":
    main()
