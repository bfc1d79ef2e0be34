"""The loop that users close: gap, cause by name, patched model, no gap.

Three of the benchmark's cases: the real arm is a MuJoCo model with an effect put in by code of its
own, the logs are those of a position controller in MuJoCo. ``python -m benchmarks.patch``: all.
"""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("mujoco")

from benchmarks.patch.arms import written_arms
from benchmarks.patch.cases import cases
from benchmarks.patch.run import run

SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("name", "effect"),
    [
        ("ur10e", "joint_offset"),  # poses
        pytest.param("seven", "axial_compliance", marks=SLOW),  # a further joint with a spring
        pytest.param("ur10e", "coulomb_friction", marks=SLOW),  # a motion; a search takes rows
    ],
)
def test_a_gap_is_named_patched_and_gone(tmp_path: Path, name: str, effect: str) -> None:
    arm = written_arms()[name]
    case = next(case for case in cases(arm) if case.effect == effect)
    found = run(arm, case, tmp_path)
    assert found["named"]
    assert not found["others"]
    assert found["found"] == pytest.approx(case.value, rel=0.02)
    assert found["verdict"] == "no_gap"
    assert found["patched"] < 0.2 * found["gap"]
