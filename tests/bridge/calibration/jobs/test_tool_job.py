"""The short session of a new tool with typed joint angles."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scripted_session import plan_in, run_calibrate, write_cell

from gapbridge.bridge.calibration.session.journal import FILE, read_entries
from gapbridge.bridge.cell import load_cell
from gapbridge.core.arm import builtin_arm
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.observables.fixed_point import fixed_at
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.predicted_readings import unmeasured_readings
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

BEGIN = np.array([0.2, -1.4, 1.6, -1.8, -1.5, 0.3])


def reported(q: np.ndarray) -> str:
    return " ".join(f"{v:.5f}" for v in np.degrees(q))


def test_the_tip_of_a_new_tool_is_found_and_written_after_a_yes(tmp_path: Path) -> None:
    cell, session = write_cell(tmp_path, joints="typed"), tmp_path / "s"
    result = run_calibrate(
        cell, "--tool-only", "--plan-only", "--session", session, lines=[reported(BEGIN)]
    )
    assert result.code == 0, result.err
    plan = plan_in(session)
    assert [load.mass for load in plan.loads] == [0.0]  # the cell's payload, not a test load
    tool = np.eye(4)
    tool[:3, 3] = 0.012, -0.008, 0.15
    true = replace(Model(builtin_arm("ur10e")), tool_in_flange=tool)
    q = np.array([p.q for p in plan.poses])
    observable = make_observable("point")
    readings = unmeasured_readings("point", q, Loads())
    point = true.predict(BEGIN[None]).position[0]
    touching = observable.solve_joints(  # type: ignore[attr-defined]
        true, q, readings, Nuisance((fixed_at(point),), np.zeros((1, 3)), np.zeros(1))
    )
    lines = [""]
    for pose in touching:
        lines += ["", reported(pose)]
    new = tmp_path / "new.yaml"
    result = run_calibrate(
        cell, "--tool-only", "--session", session, "--apply", new,
        lines=[*lines, "yes"],
    )  # fmt: skip
    assert result.code == 0, result.err + result.out[-1500:]
    found = load_cell(new).model.tool_in_flange
    np.testing.assert_allclose(found[:3, 3], tool[:3, 3], atol=5e-5)
    assert (session / "tool.html").exists()


@pytest.mark.parametrize("what", ["moved", "slipped"])
def test_a_point_that_was_moved_or_a_tip_that_slipped_needs_a_new_session(
    tmp_path: Path, what: str
) -> None:
    cell, session = write_cell(tmp_path, joints="typed"), tmp_path / "s"
    run_calibrate(cell, "--tool-only", "--plan-only", "--session", session, lines=[reported(BEGIN)])
    first, second = (reported(pose.q) for pose in plan_in(session).poses[:2])
    result = run_calibrate(
        cell, "--tool-only", "--session", session,
        lines=["", what, "", first, what, "", second, "quit"],
    )  # fmt: skip
    assert result.code == 0, result.err
    assert "no reading was taken at the present position" in result.out
    assert f"begin a new session; `{what}` is not noted" in " ".join(result.out.split())
    kinds = [entry["kind"] for entry in read_entries(session / FILE)]
    assert kinds.count("reading") == 2
    assert "moved" not in kinds


def test_joints_in_radians_are_taken_for_a_mistake(tmp_path: Path) -> None:
    cell = write_cell(tmp_path, joints="typed")
    radians = " ".join(f"{v:.4f}" for v in BEGIN)
    result = run_calibrate(
        cell, "--tool-only", "--session", tmp_path / "s", lines=["1 2 3", "", reported(BEGIN), "",
                                                                  "", radians, "quit"],
    )  # fmt: skip
    assert result.code == 0
    assert "found 3 numbers" in result.out
    assert "expected where the arm stands now" in result.out
    assert "look like radians" in result.out


@pytest.mark.parametrize("arguments", [["--tool-only"], ["--payload-only"]])
def test_short_sessions_need_to_know_where_the_arm_stands(
    tmp_path: Path, arguments: list[str]
) -> None:
    result = run_calibrate(write_cell(tmp_path), *arguments, "--session", tmp_path / "s")
    assert result.code == 2
    assert "calibration.joints" in result.err
    assert result.err.count("\n") == 1
