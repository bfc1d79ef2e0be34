"""What a loop asks of the system is taken where it is granted, and left where not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gapbridge.bridge.loop import main as realtime

ASK = """\
import sys
from gapbridge.bridge.loop import main as realtime
realtime.LATENCY, realtime.IDLE_DRIVER = sys.argv[1:3]
print(", ".join(realtime.become_realtime(float(sys.argv[3]))))
"""


def granted(file: Path, driver: Path, cycle: float) -> str:
    """Return what a process of its own is granted: it must not become this one's."""
    command = [sys.executable, "-c", ASK, str(file), str(driver), str(cycle)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


@pytest.fixture
def driver(tmp_path: Path) -> Path:
    """Return where the kernel says by what it sleeps."""
    file = tmp_path / "current_driver"
    file.write_text("intel_idle\n")
    return file


@pytest.mark.parametrize(("cycle", "asks"), [(0.002, True), (1.0 / 200.0, True), (0.008, False)])
def test_a_fast_loop_keeps_the_processors_awake(
    tmp_path: Path, driver: Path, cycle: float, asks: bool
) -> None:
    file = tmp_path / "cpu_dma_latency"
    file.write_bytes(b"")
    assert ("processors awake" in granted(file, driver, cycle)) == asks
    assert file.read_bytes() == (bytes(4) if asks else b"")


def test_where_it_is_not_granted_the_loop_runs_without(tmp_path: Path, driver: Path) -> None:
    assert "processors awake" not in granted(tmp_path / "none", driver, 0.002)


@pytest.mark.parametrize("events", ["none\n", None])
def test_where_the_kernel_could_not_do_it_nothing_is_claimed(
    tmp_path: Path, driver: Path, events: str | None
) -> None:
    file = tmp_path / "cpu_dma_latency"
    file.write_bytes(b"")
    driver.unlink() if events is None else driver.write_text(events)
    assert "processors awake" not in granted(file, driver, 0.002)
    assert file.read_bytes() == b""


@pytest.mark.skipif(
    not os.access(realtime.LATENCY, os.W_OK), reason="needs a writable /dev/cpu_dma_latency"
)
def test_the_kernel_takes_the_request(driver: Path) -> None:
    assert "processors awake" in granted(Path(realtime.LATENCY), driver, 0.002)


ORDER = """\
import gc, os
from gapbridge.bridge.loop import main as realtime
def noted(pid, policy, parameters):
    name = "FIFO" if policy == os.SCHED_FIFO else "ordinary"
    print(name, parameters.sched_priority, "collecting" if gc.isenabled() else "collected")
os.sched_setscheduler = noted
assert "real-time priority" in realtime.become_realtime(0.002)
realtime.become_ordinary()
"""


def test_real_time_priority_comes_after_what_takes_long_and_goes_before_the_end() -> None:
    command = [sys.executable, "-c", ORDER]
    found = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert found.splitlines() == [f"FIFO {realtime.PRIORITY} collected", "ordinary 0 collected"]
