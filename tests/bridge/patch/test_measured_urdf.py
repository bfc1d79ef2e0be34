"""A measured arm's geometry in a URDF: Pinocchio's kinematics against the product's prediction."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("pinocchio")

from benchmarks.patch.measured import DATA, SIMILAR, compared

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not DATA.is_dir(),
        reason="the measured data sets (../shared/data) are not beside this checkout",
    ),
]


def test_pinocchio_is_where_predict_is(tmp_path: Path) -> None:
    found = compared("tsinghua_ur5_random", tmp_path)
    assert found.apart < SIMILAR
    assert found.moved > 1e-3
    assert found.effects
