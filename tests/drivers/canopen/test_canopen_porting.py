"""What docs/porting.md says of CANopen works as it stands there, and from end to end."""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from drive_arm import follow, served, settled
from patience import PATIENCE

from gapbridge.core.errors import InputError
from gapbridge.core.log.mcap_reading import read_columns
from gapbridge.drivers.canopen.profile import read_profile
from gapbridge.drivers.canopen.settings import CanopenSettings

ROOT = Path(__file__).parents[3]
PORTING = (ROOT / "docs" / "porting.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```yaml\n(.*?)```", PORTING, re.DOTALL)


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    [text] = [block for block in BLOCKS if block.startswith("name: My drives")]
    path = tmp_path / "my_drives.yaml"
    path.write_text(text, encoding="utf-8")
    shutil.copy(CanopenSettings.shipped / "cia402.eds", tmp_path / "my_drive.eds")
    return path


def test_drives_that_no_code_knows_are_moved_from_the_pages_profile(profile: Path) -> None:
    with served(str(profile)) as arm, arm.driver() as driver:
        state = settled(driver)
        assert np.abs(state.actual_q - arm.controller.q).max() < 1e-4
        assert state.actual_current_as_torque == pytest.approx(arm.controller.joint_torque, abs=2.0)
        driver.arm(state)
        goal = np.array(arm.controller.q) + 0.03 * np.array([1, 1, -1, -1, 1, 1])
        follow(driver, goal, arm.controller)
        driver.release()
    drives = {drive.node: drive for drive in arm.server.drives}
    raw = (arm.controller.q[1] - 0.1) * -65536 * 100 / (2 * np.pi)
    assert drives[12].number(0x6064) == pytest.approx(raw, abs=1.0)


def test_a_mistake_in_the_pages_profile_is_reported_with_its_line(profile: Path) -> None:
    profile.write_text(profile.read_text().replace("node: 13", "node: 12"))
    with pytest.raises(InputError, match=r"my_drives\.yaml, line 19: joints\.3\.node: found 12 ag"):
        read_profile(profile)


def test_the_keys_of_the_page_are_the_links(profile: Path) -> None:
    from gapbridge.drivers.canopen.settings import CanopenSettings

    [text] = [block for block in BLOCKS if "driver: canopen" in block]
    keys = yaml.safe_load(text)["link"]
    assert CanopenSettings(**keys).located(profile.parent).profile_path == profile


@pytest.mark.slow
def test_a_simulated_cell_is_run_from_end_to_end(tmp_path: Path) -> None:
    """Two processes and a bus between them: simulate serves drives, run reads and records."""
    with socket.create_server(("127.0.0.1", 0)) as probe, socket.create_server(("", 0)) as other:
        port, bench = probe.getsockname()[1], other.getsockname()[1]
    cell = yaml.safe_load((ROOT / "config" / "lwa4p_canopen_simulated.yaml").read_text())
    cell["link"] |= {"host": "127.0.0.1", "port": port}
    cell["simulation"]["bench_port"] = bench
    cell["recording"] = {"folder": "."}
    (tmp_path / "cell.yaml").write_text(yaml.safe_dump(cell))
    shutil.copy(ROOT / "config" / "lwa4p_canopen.urdf", tmp_path)
    command = [sys.executable, "-m", "gapbridge"]
    served_cell = subprocess.Popen(
        [*command, "simulate", "cell.yaml"], cwd=tmp_path, stdout=subprocess.PIPE, text=True
    )
    try:
        assert served_cell.stdout is not None
        until = time.monotonic() + PATIENCE
        while "ready" not in served_cell.stdout.readline():
            assert time.monotonic() < until
        found = subprocess.run(
            [*command, "run", "cell.yaml", "--observe", "--duration", "2"],
            cwd=tmp_path, capture_output=True, text=True, timeout=120,
        )  # fmt: skip
    finally:
        served_cell.terminate()
        served_cell.wait(PATIENCE)
    assert found.returncode == 0, found.stderr
    assert "Traceback" not in found.stderr + found.stdout
    cycles = int(re.search(r"cycles (\d+)", found.stdout + found.stderr)[1])
    assert cycles > 50, found.stdout + found.stderr
    [recording] = tmp_path.glob("run-*.mcap")
    assert read_columns(recording)["actual_q"].shape[1] == 6
