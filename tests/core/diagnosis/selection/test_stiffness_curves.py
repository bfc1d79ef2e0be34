"""A joint's stiffness curve is told from a straight line by the likelihood."""

from __future__ import annotations

import pytest
from further import further

from benchmarks.blind.cases import make_case
from gapbridge.bridge.cell import load_cell
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.log.log import read_log


@pytest.mark.parametrize(
    ("kind", "seed", "cause"),
    [*further(("mixed:3", 1060004, ("stiffness_nonlinearity", (2,)))),
     ("axial_compliance", 1090000, None)],
)  # fmt: skip
def test_a_curve_with_a_sigma_of_a_third_is_accused_and_a_line_is_kept_linear(
    kind: str, seed: int, cause: tuple[str, tuple[int, ...]] | None, tmp_path
) -> None:
    """The softening's sigma grows with it: 2.4 of them where the likelihood gains 87."""
    make_case(kind, seed, tmp_path)
    cell = load_cell(tmp_path / "cell.yaml")
    found = diagnose(cell.model, read_log(tmp_path / "log.csv", cell.arm.n), cell.metrology)
    (channel,) = [c for c in found.channels if c.channel == "position"]
    curves = [(c.effect, c.joints) for c in channel.causes if c.effect == "stiffness_nonlinearity"]
    assert curves == ([cause] if cause else [])
