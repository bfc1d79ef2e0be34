"""The whole way on CAN: `simulate` serves a PiPER, `run` bends its setpoints, a tracker looks."""

import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from patience import PATIENCE, wait_for
from ports import free_port, own_host

from gapbridge.bridge.cell import load_cell

CONFIG = Path(__file__).parents[3] / "config"
HOST = own_host()
BENCH = free_port(HOST)
SOFT = """
compliance: &soft
  axial: [3.0e-5, 6.0e-5, 8.0e-5, 1.0e-4, 1.2e-4, 1.2e-4]
  radial: [5.0e-6, 8.0e-6, 1.0e-5, 1.0e-5, 2.0e-5, 2.0e-5]
"""


@contextmanager
def gapbridge(*phrase):
    code = [sys.executable, "-m", "gapbridge", *map(str, phrase)]
    with subprocess.Popen(code, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as process:
        try:
            yield process
        finally:
            process.terminate()
            process.communicate(timeout=PATIENCE)


def measured():
    """Return the tracker's mean of five positions (3,), m."""
    found = []
    with socket.create_connection((HOST, BENCH), timeout=PATIENCE) as bench:
        answers = bench.makefile()
        for _ in range(5):
            bench.sendall(b"measure\n")
            found.append([float(v) for v in answers.readline().split(",")[1:4]])
    return np.mean(found, axis=0)


def serves():
    try:
        measured()
    except OSError:
        return False
    return True


@pytest.mark.slow
def test_a_soft_piper_comes_to_where_it_was_meant_to_be(tmp_path):
    text = (CONFIG / "piper_can_simulated.yaml").read_text()
    text = text.replace("127.0.0.2", HOST).replace("arm: false", "arm: true")
    text = text.replace("state_timeout: 0.1 ", "state_timeout: 0.5 ")
    text += f"  bench_port: {BENCH}\n  compliance: *soft\n"
    cell = tmp_path / "cells" / "cell.yaml"
    cell.parent.mkdir()
    cell.write_text(SOFT + text)
    (cell.parent / "piper.urdf").write_text((CONFIG / "piper.urdf").read_text())
    found = load_cell(cell)
    wanted = found.model.rigid_pose(np.array([found.file.simulation.start_q])).position[0]

    def error():
        return float(np.linalg.norm(measured() - wanted))

    with gapbridge("simulate", cell):
        wait_for(serves, "a reading")
        bare = error()
        assert bare > 3e-4
        with gapbridge("run", cell):
            wait_for(lambda: error() < bare / 5, "the corrected arm")
            time.sleep(2.0)
            settled = error()
    assert settled < max(bare / 4, 1.2e-4)  # what is left is the arm's own repeatability
