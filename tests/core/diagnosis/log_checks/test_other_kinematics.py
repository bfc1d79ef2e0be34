"""A model that is another arm's is called by the mistake that made it one."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from gapbridge.bridge.document.log_findings import log_finding_text
from gapbridge.core.arm import arm_from_dh, builtin_arm, builtin_rows
from gapbridge.core.diagnosis.log_checks.frames import dh_rows, frame_findings
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.rotation import rpy_matrix, transform

# UR10e in Craig's convention: a and alpha of the link before, with some tool and joint zeros
ROWS = [dict(row) for row in builtin_rows("ur10e")["dh"]]
for index, row in enumerate(ROWS):
    row["offset"] = 0.1 * index
CRAIG = [
    {"a": before.get("a", 0.0), "alpha": before.get("alpha", 0.0), "d": row["d"],
     "offset": row["offset"]}
    for before, row in zip([{}, *ROWS], ROWS, strict=False)
]  # fmt: skip
TOOL = transform(rpy_matrix(np.array([0.2, -0.1, 0.3])), np.array([0.02, -0.05, 0.18]))
TRUE = Model(arm_from_dh(ROWS), tool_in_flange=TOOL)
RNG = np.random.default_rng(3)
Q = RNG.uniform(-2.5, 2.5, (40, 6))
INSTRUMENT = transform(rpy_matrix(np.array([0.3, 0.2, 1.4])), np.array([2.0, -1.0, 0.4]))


def texts(model: Model, log: Log) -> list[str]:
    return [log_finding_text(f) for f in frame_findings(model, log, Metrology())]


def reported(model: Model, q: np.ndarray, **more: np.ndarray) -> list[str]:
    position = TRUE.rigid_pose(Q).position @ INSTRUMENT[:3, :3].T + INSTRUMENT[:3, 3]
    position += RNG.normal(0, 2e-5, position.shape)
    columns = {"actual_q": q, "measured_position": position} | more
    return texts(model, Log("arm.csv", columns, 6))


def with_rows(**changed: float) -> Model:
    rows = [row | {k: row[k] * f for k, f in changed.items()} for row in ROWS]
    return replace(TRUE, arm=arm_from_dh(rows))


def test_the_arm_itself_is_not_suspected() -> None:
    assert reported(TRUE, Q) == []


def test_another_builtin_arm_is_named() -> None:
    right, wrong = (replace(TRUE, arm=builtin_arm(name)) for name in ("ur10e", "ur5e"))
    (note,) = reported(wrong, Q, measured_position=right.rigid_pose(Q).position)
    assert "they look like those of a ur10e: then 0.0 mm" in note


def test_a_point_of_the_cell_seen_from_the_tool_is_named_without_rotations() -> None:
    poses = TRUE.rigid_pose(Q)
    inverted = np.einsum("nji,nj->ni", poses.rotation, np.array([1.5, 0.2, 0.4]) - poses.position)
    (note,) = reported(TRUE, Q, measured_position=inverted)
    assert "they look inverted: the base seen from the tool: then 0.0 mm" in note


def test_positions_that_never_change_are_reported_without_a_warning_of_numpy() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (note,) = reported(TRUE, Q, measured_position=np.zeros((40, 3)))
    assert "is it the right arm, tool and order" in note


@pytest.mark.parametrize(
    ("model", "order", "phrase"),
    [
        (TRUE, [2, 1, 0, 3, 4, 5], "joints 1 and 3 look swapped (a UR's elbow and shoulder pan"),
        (TRUE, [0, 1, 2, 4, 3, 5], "joints 4 and 5 look swapped: then 0.0 mm"),
        (TRUE, [5, 4, 3, 2, 1, 0], "the joints seem to be in reverse order"),
        (TRUE, [1, 2, 0, 3, 4, 5], "joint 1 is column _2, joint 2 is column _0, joint 3 is"),
        (replace(TRUE, arm=arm_from_dh(CRAIG)), None, "looks like modified DH rows (Craig)"),
        (with_rows(a=-1.0), None, "a of the DH rows seems to have the wrong sign"),
        (with_rows(offset=-1.0), None, "offset of the DH rows seems to have the wrong sign"),
        (with_rows(a=1 / 0.0254, d=1 / 0.0254), None, "lengths of the DH rows look like inches"),
        (replace(TRUE, tool_in_flange=transform(TOOL[:3, :3], -TOOL[:3, 3])), None, "tool.tcp"),
        (Model(TRUE.arm), None, "lies at (20, -50, 180) mm in the flange's frame, the cell decl"),
        (
            replace(TRUE, tool_in_flange=transform(TOOL[:3, :3], TOOL[:3, 3] + [0.1, 0.0, 0.0])),
            None,
            "lies at (20, -50, 180) mm in the flange's frame, tool.tcp says (120, -50, 180)",
        ),
    ],
)
def test_what_fits_is_named(model: Model, order: list[int] | None, phrase: str) -> None:
    (line,) = reported(model, Q if order is None else Q[:, order])
    assert "do not follow the arm" in line
    assert phrase in line


def test_outliers_hide_no_missing_tool() -> None:
    position = TRUE.rigid_pose(Q).position @ INSTRUMENT[:3, :3].T + INSTRUMENT[:3, 3]
    position[[3, 17, 30]] += 0.5
    columns = {"actual_q": Q, "measured_position": position}
    (line,) = texts(Model(TRUE.arm), Log("arm.csv", columns, 6))
    assert "lies at (20, -50, 180) mm" in line


def test_another_arm_is_reported_without_a_guess() -> None:
    (line,) = reported(Model(builtin_arm("ur3e")), Q)
    assert line.endswith("is it the right arm, tool and order of joints and rows?")


def test_dh_rows_come_back_from_an_arm() -> None:
    expected = [[row["a"], row["alpha"], row["d"], row["offset"]] for row in ROWS]
    found = dh_rows(TRUE.arm)
    assert found is not None
    np.testing.assert_allclose(found, expected, atol=1e-12)
