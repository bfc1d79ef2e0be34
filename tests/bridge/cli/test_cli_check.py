"""``gapbridge check`` and ``init``, with the simulated controller where one is needed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_runs import gapbridge, refused
from daemon_cell import plant

from gapbridge.bridge.cell import load_cell
from gapbridge.core.arm import builtin_arm
from gapbridge.core.plausibility import flange_in_first
from gapbridge.drivers.simulated.ur.process import SimulatedController
from gapbridge.drivers.simulated.ur.settings import announced_rows
from gapbridge.drivers.ur_rtde.enquiry import enquire

DELTAS = {
    "delta_theta": [1e-7, -1e-4, 2e-4, 1e-4, 0.0, 0.0],
    "delta_a": [1e-5, 3e-4, -2e-4, 0.0, 0.0, 0.0],
    "delta_d": [1e-4, 439.14, -439.1399, 1e-4, 0.0, 0.0],  # meet far out and cancel
    "delta_alpha": [-3e-4, 1e-6, -1e-6, 2e-4, 1e-4, 0.0],
}


@pytest.fixture(scope="module")
def host() -> Iterator[str]:
    settings = replace(plant(), calibrated=announced_rows("ur10e", DELTAS))
    with SimulatedController(settings) as running:
        yield running.host


def cell(folder: Path, host: str, tcp: str = "0.18", more: str = "") -> Path:
    path = folder / "cell.yaml"
    path.write_text(
        f"robot: {{model: ur10e}}\ntool: {{tcp: {{xyz: [0, 0, {tcp}]}}}}\n"
        f"payload: {{mass: 5, cog: [0, 0, 0.06]}}\nlink: {{host: {host}}}\n{more}",
        encoding="utf-8",
    )
    return path


def test_a_cell_that_is_wrong_ends_with_two_and_every_line(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text("robot: {model: ur10e}\ngravity: [0, 0, -1]\nreference_temperature: 298\n")
    answer = gapbridge("check", path)
    assert answer.code == 2
    lines = answer.err.splitlines()
    assert [line.split(": ")[2] for line in lines] == ["gravity", "reference_temperature"]
    assert all(line.startswith(f"error: {path}, line ") for line in lines)


def test_a_fit_cell_ends_with_zero_and_says_so(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text("robot: {model: ur10e}\nmetrology: {sigma: 0.005}\n")
    answer = gapbridge("check", path)
    assert answer.code == 0
    assert answer.out == f"{path}: fit to be used, 1 warning\n"
    assert answer.err.startswith(f"warning: {path}, line 2: metrology.sigma")


def test_every_command_refuses_it_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text("robot: {model: ur10e}\ntool: {tcp: {xyz: [0, 0, 180]}}\nlink: {}\n")
    (tmp_path / "log.csv").write_text("actual_q_0\n0\n")
    for command in (("predict", tmp_path / "log.csv", "--out", tmp_path / "o.csv", "--cell"),
                    ("run",), ("simulate",)):  # fmt: skip
        assert f"{path}, line 2: tool.tcp.xyz: found 180 m" in refused(*command, path)


def test_the_controller_reports_what_it_is(host: str) -> None:
    facts = enquire(host)
    assert (facts.n, facts.model, facts.version, facts.rate) == (6, "ur10e", "5.15.0", 500.0)
    assert facts.payload == 5.0
    assert facts.payload_cog is not None
    assert facts.tcp is not None
    np.testing.assert_allclose(facts.payload_cog, [0, 0, 0.06])
    np.testing.assert_allclose(facts.tcp[:3, 3], [0, 0, 0.18])
    for key, values in DELTAS.items():
        np.testing.assert_allclose(facts.calibration[key], values, atol=1e-12)
    arm = builtin_arm("ur10e")
    assert facts.lower is not None
    assert facts.velocity is not None
    np.testing.assert_allclose(facts.lower, arm.limits.lower)
    np.testing.assert_allclose(facts.velocity, arm.limits.velocity)


def test_live_reports_where_the_controller_differs(host: str, tmp_path: Path) -> None:
    answer = gapbridge("check", cell(tmp_path, host, "0.25"), "--live")
    assert answer.code == 2
    assert "line 2: tool.tcp: found a TCP 70 mm" in answer.err
    assert "line 1: robot.calibration: found geometry up to" in answer.err


def test_live_passes_the_controllers_own_cell(host: str, tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    assert gapbridge("init", host, "--out", path).code == 0
    answer = gapbridge("check", path, "--live")
    assert answer.code == 0, answer.err
    found = load_cell(path)
    assert found.warnings == ()
    assert found.model.payload_mass == 5.0
    np.testing.assert_allclose(found.model.tool_in_flange[:3, 3], [0, 0, 0.18])
    q = np.random.default_rng(1).uniform(-3, 3, (20, 6))
    np.testing.assert_allclose(
        flange_in_first(found.arm, q), flange_in_first(builtin_arm("ur10e", DELTAS), q), atol=1e-9
    )
    assert "# " in path.read_text()


def test_init_overwrites_nothing_and_needs_a_controller(host: str, tmp_path: Path) -> None:
    path = tmp_path / "own.yaml"
    path.write_text("kept")
    assert "already there" in refused("init", host, "--out", path)
    assert path.read_text() == "kept"
    answer = gapbridge("init", "127.9.9.9", "--out", tmp_path / "new.yaml")
    assert answer.code == 1
    assert "127.9.9.9" in answer.err
    assert not (tmp_path / "new.yaml").exists()


def test_a_cell_with_another_tcp_does_not_arm(host: str, tmp_path: Path) -> None:
    more = f"compliance: {{axial: {[1e-5] * 6}}}\nrecording: {{folder: out}}\n"
    path = cell(tmp_path, host, "0.25", more)
    answer = gapbridge("run", path, "--arm", "--duration", "3")
    assert answer.code != 0
    assert "tool.tcp: found a TCP 70 mm" in answer.out + answer.err
