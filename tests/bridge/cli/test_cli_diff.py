"""``gapbridge diff``: changed keys, and shifts of the TCP."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cli_runs import gapbridge, refused

BEFORE = "robot: {model: ur10e}\ntool: {tcp: {xyz: [0, 0, 0.18]}}\n"


def cells(folder: Path, after: str) -> tuple[Path, Path]:
    paths = folder / "before.yaml", folder / "after.yaml"
    for path, text in zip(paths, (BEFORE, after), strict=True):
        path.write_text(text, encoding="utf-8")
    return paths


def test_a_longer_tool_moves_the_tcp_by_as_much_everywhere(tmp_path: Path) -> None:
    paths = cells(tmp_path, BEFORE.replace("0.18", "0.183"))
    answer = gapbridge("diff", *paths)
    assert answer.code == 0
    expected = "TCP: (0, 0, 180) mm -> (0, 0, 183) mm in the flange frame, 3.000 mm apart; alone"
    assert f"{expected} 3.000 mm rms at the TCP, at most 3.000 mm" in answer.out
    assert "moves by 3.000 mm rms, at most 3.000 mm" in answer.out


def test_an_effect_and_a_flexibility_are_named(tmp_path: Path) -> None:
    more = (
        "compliance: {axial: [0, 1e-5, 0, 0, 0, 0]}\n"
        "effects: [{effect: joint_offset, joint: 1, parameters: {value: 0.001}}]\n"
    )
    answer = gapbridge("diff", *cells(tmp_path, BEFORE + more), "--json")
    reported = json.loads(answer.out)
    assert {c["key"] for c in reported["changes"]} == {
        "effect joint_offset of joint 1", "compliance.axial"
    }  # fmt: skip
    assert [p["words"] for p in reported["parts"]] == [
        "joint zero is off (joint_offset) of joint 1: added, 1 mrad",
        "joint twists under load (axial_compliance) of joint 2: added, 10 µrad/Nm",
    ]
    alone = [p["moved"]["rms"] for p in reported["parts"]]
    assert alone[0] > alone[1] > 1e-5
    assert 1e-4 < reported["moved"]["rms"] < reported["moved"]["largest"] < 0.02
    assert reported["moved"]["poses"] == 200
    origin = reported["provenance"]
    assert (origin["command"], len(origin["files"])) == ("diff", 2)
    assert all(len(file["sha256"]) == 64 for file in origin["files"])


def test_over_a_log_only_its_poses_count(tmp_path: Path) -> None:
    more = "effects: [{effect: joint_offset, joint: 1, parameters: {value: 0.001}}]\n"
    paths = cells(tmp_path, BEFORE + more)
    log = tmp_path / "log.csv"
    q = np.tile([0.0, -1.2, 1.5, -1.8, -1.5, 0.0], (3, 1)) + np.arange(3)[:, None] * 1e-4
    names = ",".join(f"actual_q_{i}" for i in range(6))
    np.savetxt(log, q, delimiter=",", header=names, comments="")
    reported = json.loads(gapbridge("diff", *paths, "--log", log, "--json").out)["moved"]
    assert reported["poses"] == 3
    assert reported["rms"] == pytest.approx(reported["largest"], rel=1e-2)  # one place, one radius


def test_cells_that_agree_and_cells_of_other_joints(tmp_path: Path) -> None:
    paths = cells(tmp_path, BEFORE)
    out = gapbridge("diff", *paths).out
    assert "no key differs" in out
    assert "the predicted TCP is the same" in out
    rows = [{"a": 0.3, "alpha": 0.0, "d": 0.1, "mass": 1.0}] * 3
    paths[1].write_text(f"robot: {{dh: {rows}}}\n".replace("'", ""), encoding="utf-8")
    assert "cannot be compared" in gapbridge("diff", *paths).out
    assert "not found" in refused("diff", paths[0], tmp_path / "none.yaml")


def test_an_effect_that_a_joint_has_twice_counts_whole(tmp_path: Path) -> None:
    entry = "{effect: joint_offset, joint: 1, parameters: {value: %s}}"
    twice = f"effects: [{entry}, {entry}]\n"
    paths = cells(tmp_path, BEFORE + twice % ("0.005", "0.002"))
    paths[0].write_text(BEFORE + twice % ("0.001", "0.002"), encoding="utf-8")
    out = gapbridge("diff", *paths).out
    assert "(joint_offset) of joint 1: 1 + 2 -> 2 + 5 mrad; alone" in out
    changes = json.loads(gapbridge("diff", *paths, "--json").out)["changes"]
    assert changes[0]["before"] == [{"value": 0.001}, {"value": 0.002}]
    paths[0].write_text(BEFORE + twice % ("0.002", "0.005"), encoding="utf-8")
    assert "no key differs" in gapbridge("diff", *paths).out


def test_poses_without_equilibrium_are_left_out(tmp_path: Path) -> None:
    limp = f"compliance: {{axial: {[0.005] * 6}}}\npayload: {{mass: 12}}\n"
    answer = gapbridge("diff", *cells(tmp_path, BEFORE + limp), "--json")
    assert answer.code == 0
    assert 0 < json.loads(answer.out)["moved"]["poses"] < 200


def test_a_link_with_and_without_its_second_twist_is_compared(tmp_path: Path) -> None:
    nearly = "robot: {model: ur10e, calibration: {delta_alpha: [0, 1e-3, 0, 0, 0, 0]}}\n"
    entry = "effects: [{effect: link_geometry, joint: 2, parameters: {a: 1e-4, d: 0, alpha: 0%s}}]"
    paths = cells(tmp_path, nearly + entry % ", beta: 1e-3")
    paths[0].write_text(nearly + entry % "", encoding="utf-8")
    assert "a 0.1 -> 0.1 mm, beta 0 -> 1 mrad; alone" in gapbridge("diff", *paths).out
