"""The tests on hardware, run against a simulated controller that is served as a user would."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest
from ports import own_host

HERE = Path(__file__).parent
CELL = """\
robot: {model: ur10e}
link: {driver: modbus, profile: ur, host: %(host)s, port: 15020}
"""


def run_hil(*options: str) -> tuple[int, str]:
    found = subprocess.run(
        [sys.executable, "-m", "pytest", str(HERE / "test_hil.py"), "-rs", "-p", "no:cacheprovider",
         "-q", *options],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    return found.returncode, found.stdout + found.stderr


@pytest.mark.slow
def test_it_only_reads_unless_motion_is_allowed(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(CELL % {"host": own_host()})
    served = subprocess.Popen(
        [sys.executable, "-m", "gapbridge", "simulate", str(cell)],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert served.stdout is not None
        assert "Modbus 15020" in served.stdout.readline()
        assert served.stdout.readline().startswith("ready")
        code, text = run_hil("--cell", str(cell))
        assert code == 0, text
        assert "the arm must not move: give --allow-motion" in text
        code, text = run_hil("--cell", str(cell), "--allow-motion")
        assert code == 0, text
        assert "skipped" not in text
    finally:
        served.send_signal(signal.SIGTERM)
        served.wait(10.0)


@pytest.mark.slow
def test_a_cell_that_cannot_be_used_is_reported_in_a_line(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text("robot: {model: ur10e}\nlink: {driver: modbus, profile: nobody}\n")
    code, text = run_hil("--cell", str(cell))
    assert code == 2
    assert "link.profile: found 'nobody', expected one of doosan, elite_ec" in text
