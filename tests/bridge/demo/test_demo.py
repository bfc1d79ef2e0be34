"""The demo as a user runs it: the command, the real protocol, its processes."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.demo.job import run_demo
from gapbridge.bridge.demo.links.link import free_address
from gapbridge.bridge.demo.links.ur_rtde import UrRtdeLink
from gapbridge.core.errors import InputError
from gapbridge.core.log.log import read_log

ROOT = Path(__file__).parents[3]


def test_an_unknown_link_is_reported_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="found 'modbus_tpc', expected one of ur_rtde"):
        run_demo(1, tmp_path, "modbus_tpc")
    assert not list(tmp_path.iterdir())


def test_an_address_that_is_taken_is_passed_over() -> None:
    first = free_address(UrRtdeLink.ports)
    with socket.socket() as taken:
        taken.bind((first, UrRtdeLink.ports[0]))
        taken.listen()
        assert free_address(UrRtdeLink.ports) != first


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_demo_shows_what_it_states(tmp_path: Path) -> None:
    out = tmp_path / "out" / "demo"
    command = [sys.executable, "-m", "gapbridge", "demo", "--seed", "5", "--out", str(out)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    ran = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "times smaller" in ran.stdout
    summary = json.loads((out / "summary.json").read_text())
    error, repeatability = summary["tcp_error_mm"], summary["repeatability_mm"]
    assert summary["link"] == "ur_rtde"
    assert error["without"]["rms"] > 20 * error["with"]["rms"]
    assert error["with"]["rms"] < 1.5 * repeatability
    assert error["with"]["max"] < error["without"]["max"]
    assert error["fitted"]["rms"] > 10 * error["with"]["rms"]  # what no fit knows
    for name, true in summary["hidden"].items():
        assert summary["accused"][name]["value"] == pytest.approx(true, abs=6e-5)
    assert 0.01 < repeatability < 0.1
    slower = 2 ** " ".join(ran.stdout.split()).count(" of the rate")
    loop = summary["loop"]
    # of the controller's clock; a busy machine misses cycles, and none goes without being counted
    assert 0.9 * 500 / slower < loop["rate_hz"] * loop["cycles"] / (loop["cycles"] - loop["missed"])
    assert loop["rate_hz"] < 1.01 * 500
    assert "<script src" not in (out / "report.html").read_text()
    rigid, calibrated = load_cell(out / "cell.yaml"), load_cell(out / "calibrated.yaml")
    assert rigid.model.terms == ()
    assert len(calibrated.model.terms) > 6
    explained = load_cell(out / "explained.yaml")
    effects, further = ({t.effect for t in c.model.terms} for c in (calibrated, explained))
    assert effects < further
    diagnosis = json.loads((out / "diagnosis" / "diagnosis.json").read_text())
    assert diagnosis["verdict"] in ("explained", "partly_explained")
    assert diagnosis["channels"][0]["gap_rms"] > 3e-4
    assert summary["setpoints_written"] > 20_000 / slower
    log = read_log(out / "calibration.csv", 6)
    assert len(log) == summary["samples"]
    assert set(log.require("payload").tolist()) == {5.0, 12.0, 4.0}
