"""A simulator's log at the joint angles of the real one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.opened_log import at_joints_of
from gapbridge.core.log.log import Log
from gapbridge.core.rotation import rotation_matrix, rotation_vector


def test_a_simulated_servo_that_rests_elsewhere_is_no_gap_of_the_position(tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_text("robot: {model: ur5e}\n")
    cell = load_cell(tmp_path / "cell.yaml")
    q = np.random.default_rng(2).uniform(-1, 1, (5, 6))
    rests = q + 3e-4
    log = Log("log.csv", {"actual_q": q}, 6)
    given = np.add(cell.model.predict(rests).position, [0, 0, 1e-3])
    turn = rotation_matrix(np.array([[1e-3, 0, 2e-3]]))
    turned = {k: rotation_vector(turn @ cell.model.predict(v).rotation)
              for k, v in (("rests", rests), ("q", q))}  # fmt: skip
    columns = {"measured_position": given, "measured_rotation": turned["rests"]}
    simulated = Log("sim.csv", {"actual_q": rests, **columns}, 6)
    found = at_joints_of(log, simulated, cell)
    expected = np.add(cell.model.predict(q).position, [0, 0, 1e-3])
    assert np.allclose(found.require("measured_position"), expected, rtol=0, atol=1e-12)
    assert np.allclose(found.require("measured_rotation"), turned["q"], rtol=0, atol=1e-5)
    assert np.array_equal(found.require("actual_q"), rests)


def test_a_simulated_log_without_joints_stays_as_it_is(tmp_path: Path) -> None:
    (tmp_path / "cell.yaml").write_text("robot: {model: ur5e}\n")
    cell = load_cell(tmp_path / "cell.yaml")
    simulated = Log("sim.csv", {"measured_position": np.ones((2, 3))}, 6)
    log = Log("log.csv", {"actual_q": np.zeros((2, 6))}, 6)
    assert at_joints_of(log, simulated, cell) is simulated
