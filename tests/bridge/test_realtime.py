"""What a loop asks of the system is taken where it is granted, and left where not."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from bridge import realtime

ASK = """\
import sys
from bridge import realtime
realtime.LATENCY = sys.argv[1]
print(", ".join(realtime.become_realtime(float(sys.argv[2]))))
"""


def granted(file: Path, cycle: float) -> str:
    """Return what a process of its own is granted: it must not become this one's."""
    command = [sys.executable, "-c", ASK, str(file), str(cycle)]
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=60).stdout


@pytest.mark.parametrize(("cycle", "asks"), [(0.002, True), (1.0 / 200.0, True), (0.008, False)])
def test_a_fast_loop_keeps_the_processors_awake(tmp_path: Path, cycle: float, asks: bool) -> None:
    file = tmp_path / "cpu_dma_latency"
    file.write_bytes(b"")
    assert ("processors awake" in granted(file, cycle)) == asks
    assert file.read_bytes() == (bytes(4) if asks else b"")


def test_where_it_is_not_granted_the_loop_runs_without(tmp_path: Path) -> None:
    assert "processors awake" not in granted(tmp_path / "none", 0.002)


@pytest.mark.skipif(
    not os.access(realtime.LATENCY, os.W_OK), reason="needs a writable /dev/cpu_dma_latency"
)
def test_the_kernel_takes_the_request() -> None:
    assert "processors awake" in granted(Path(realtime.LATENCY), 0.002)
