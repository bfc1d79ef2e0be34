"""Settings of the instrument in the cell affect the plan and the prompts."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from further import further
from scripted_session import (
    FRAME,
    plan_in,
    reading_line,
    run_calibrate,
    tracker_readings,
    write_cell,
)

from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.planning import make_plan, workspace_of
from gapbridge.bridge.calibration.session.journal import FILE, read_entries
from gapbridge.bridge.cell import load_cell
from gapbridge.core.calibration.plan import Plan
from gapbridge.core.model import Model

INSTRUMENT_AT = (2.5, -0.8, 0.6)


def cell_with(folder: Path, *lines: str, **changed: object) -> Path:
    path = write_cell(folder, **{"poses": 12, "held_out": 8, **changed})
    with path.open("a", encoding="utf-8") as file:
        file.write("".join(f"  {line}\n" for line in lines))
    return path


def plan_with(folder: Path, *lines: str, **changed: object) -> tuple[Plan, Model]:
    cell = load_cell(cell_with(folder, *lines, **changed))
    options = SessionOptions("whole", None, cell.calibration.instrument)
    return make_plan(cell, options, lambda text, share: None), cell.model


@pytest.mark.slow
def test_poses_that_turn_the_reflector_away_are_not_planned(tmp_path: Path) -> None:
    plan, model = plan_with(
        tmp_path,
        f"instrument_at: {list(INSTRUMENT_AT)}",
        "reflector: {looks: [0, 0, 2], acceptance: 0.5}",
    )
    free, _ = plan_with(tmp_path, f"instrument_at: {list(INSTRUMENT_AT)}")
    turned = [_angle(p, model) for p in (plan, free)]
    assert turned[0].max() < 0.5
    assert turned[1].max() > 0.5


def _angle(plan: Plan, model: Model) -> np.ndarray:
    poses = model.rigid_pose(np.array([p.q for p in plan.poses]))
    way = np.array(INSTRUMENT_AT) - poses.position
    cosine = np.einsum("ni,ni->n", way, poses.rotation[:, :, 2]) / np.linalg.norm(way, axis=1)
    return np.asarray(np.arccos(cosine))


@pytest.mark.parametrize(
    ("kind", "near", "far"),
    [("{kind: typed, unit: m}", 2.0, 2.6), *further(("{kind: dial_gauge, unit: mm}", 1.9, 2.7))],
)
def test_poses_out_of_the_instruments_range_are_not_planned(
    tmp_path: Path, kind: str, near: float, far: float
) -> None:
    plan, model = plan_with(
        tmp_path, f"instrument_at: {list(INSTRUMENT_AT)}",
        f"instrument_range: {{nearest: {near}, farthest: {far}}}", instrument=kind, poses=24,
    )  # fmt: skip
    position = model.rigid_pose(np.array([p.q for p in plan.poses])).position
    apart = np.linalg.norm(position - np.array(INSTRUMENT_AT), axis=1)
    assert near <= apart.min() + 1e-9
    assert apart.max() - 1e-9 <= far


@pytest.mark.slow
def test_an_instrument_is_moved_through_its_planned_places(tmp_path: Path) -> None:
    cell = cell_with(
        tmp_path, f"instrument_at: {list(INSTRUMENT_AT)}", "further_places: [[-2.0, 1.0, 0.5]]",
        "reflector: {looks: [0, 0, 1], acceptance: 0.7}", registered="true", poses=20,
    )  # fmt: skip
    session = tmp_path / "s"
    result = run_calibrate(cell, "--plan-only", "--session", session)
    assert result.code == 0, result.err
    assert "place 2: (-2, 1, 0.5) m in base" in result.out
    plan = plan_in(session)
    stations = [p.station for p in plan.poses]
    assert set(stations) == {0, 1}
    assert stations == sorted(stations)
    table = np.genfromtxt(session / "poses.csv", delimiter=",", names=True)
    np.testing.assert_array_equal(table["place"], stations)
    one, other = tracker_readings(plan, frame=None), tracker_readings(plan, frame=FRAME)
    lines: list[str] = []
    for i, pose in enumerate(plan.poses):
        if i and pose.station != plan.poses[i - 1].station:
            lines.append("")  # the instrument is placed
        if not i or pose.load != plan.poses[i - 1].load:
            lines.append("")  # the load is mounted
        lines.append(reading_line((other if pose.station else one)[i]))
    result = run_calibrate(cell, "--session", session, lines=[*lines, "yes"])
    assert result.code == 0, result.err + result.out[-1500:]
    carried = "place 2 · the instrument at about (-2, 1, 0.5) m in base"
    assert carried in result.out, result.out[-1500:]
    readings = [e for e in read_entries(session / FILE) if e["kind"] == "reading"]
    assert [e["station"] for e in readings] == stations


@pytest.mark.slow
def test_a_tip_on_one_point_is_planned_and_needs_its_place(tmp_path: Path) -> None:
    plan, model = plan_with(
        tmp_path, "instrument_at: [0.7, 0.2, 0.4]", instrument="{kind: point}", poses=16
    )
    position = model.rigid_pose(np.array([p.q for p in plan.poses])).position
    np.testing.assert_allclose(position - [0.7, 0.2, 0.4], 0.0, atol=5e-3)  # the arm bends


@pytest.mark.parametrize(
    ("lines", "changed", "phrase"),
    [
        ([], {"instrument": "{kind: point}"}, "expected where the point is"),
        (["further_places: [[1, 2, 3]]"], {}, "found nothing beside further_places"),
        (["reflector: {looks: [0, 0, 1], acceptance: 0.5}"], {}, "found nothing beside reflector"),
        (["instrument_range: {nearest: 1}"], {}, "found nothing beside instrument_range"),
        (
            ["instrument_at: [2, 0, 1]", "reflector: {looks: [0, 0, 0], acceptance: 0.5}"], {},
            "reflector.looks: found no length",
        ),
        (
            ["instrument_at: [2, 0, 1]", "instrument_range: {nearest: 3, farthest: 2}"], {},
            "found nearest 3 and farthest 2",
        ),
        (
            ["instrument_at: [1, 0, 0]", "instrument_range: {nearest: 1}"],
            {"instrument": "{kind: sphere}"}, "found it with a sphere that is touched",
        ),
        (["instrument_at: [2, 0, 1]", "reflector: {looks: [0, 0, 1]}"], {}, "acceptance"),
    ],
)  # fmt: skip
def test_contradicting_settings_are_refused_in_one_line(
    tmp_path: Path, lines: list[str], changed: dict[str, object], phrase: str
) -> None:
    result = run_calibrate(
        cell_with(tmp_path, *lines, **changed), "--plan-only", "--session", tmp_path / "s"
    )
    assert result.code == 2
    assert phrase in result.err
    assert re.fullmatch(r"error: .*/cell\.yaml, line \d+: calibration\..*\n", result.err)


def test_a_refused_start_does_not_block_the_corrected_cell(tmp_path: Path) -> None:
    refused = run_calibrate(
        cell_with(tmp_path, "floor: 3"), "--plan-only", "--session", tmp_path / "s"
    )
    assert (refused.code, "pose" in refused.err) == (2, True)
    corrected = cell_with(tmp_path)
    corrected.write_text(corrected.read_text().replace("0.18", "0.19"))
    result = run_calibrate(corrected, "--plan-only", "--session", tmp_path / "s")
    assert result.code == 0, result.err
    begun = [e for e in read_entries(tmp_path / "s" / FILE) if e["kind"] == "begun"]
    assert len(begun) == 1  # the refused start left nothing


def test_loads_count_in_collision_checks(tmp_path: Path) -> None:
    from gapbridge.bridge.calibration.planning import loads_of, with_loads

    cell = load_cell(cell_with(tmp_path))
    bare = workspace_of(cell, "position")
    loaded = with_loads(bare, loads_of(cell))
    q = bare.draw(2000, np.random.default_rng(0))
    assert (loaded.clear(q) & ~bare.clear(q)).sum() == 0
    assert loaded.clear(q).sum() < bare.clear(q).sum()


def test_the_arms_limits_are_kept_clear_of_and_a_joint_range_is_used_as_it_is(
    tmp_path: Path,
) -> None:
    def limits(*lines: str) -> tuple[np.ndarray, np.ndarray]:
        cell = load_cell(cell_with(tmp_path, *lines))
        lower, upper = np.full(6, -2.0), np.array([2.0] * 5 + [-1.96])
        arm = replace(cell.arm, limits=replace(cell.arm.limits, lower=lower, upper=upper))
        workspace = workspace_of(replace(cell, model=replace(cell.model, arm=arm)), "position")
        return workspace.lower, workspace.upper

    lower, upper = limits()
    np.testing.assert_allclose(lower, [-1.95] * 5 + [-1.99])
    np.testing.assert_allclose(upper, [1.95] * 5 + [-1.97])
    lower, upper = limits(f"joint_range: {{lower: {[-2.0] * 6}, upper: {[-1.99] * 6}}}")
    np.testing.assert_allclose(lower, [-2.0] * 6)
    np.testing.assert_allclose(upper, [-1.99] * 6)
