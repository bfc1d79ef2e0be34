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
    [
        *further(("mixed:3", 1060004, ("stiffness_nonlinearity", (2,)))),
        ("axial_compliance", 1090000, None),
        # a line beside the curve in the model followed it, and the search went on between the two
        ("size:stiffness_nonlinearity@2", 1620001, ("stiffness_nonlinearity", (2,))),
        # its curvature, 3.9 sigmas, was held nominal as a number that the log does not determine
        ("size:stiffness_nonlinearity@2", 1620004, ("stiffness_nonlinearity", (1,))),
    ],
)
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


def test_the_curve_of_a_wrist_is_not_pulled_to_that_of_a_shoulder(tmp_path) -> None:
    """Joint 4 of a large arm bends at a fiftieth of what its shoulder holds."""
    truth = make_case("hard:stiffness_nonlinearity", 1320008, tmp_path).causes[0].parameters
    cell = load_cell(tmp_path / "cell.yaml")
    found = diagnose(cell.model, read_log(tmp_path / "log.csv", cell.arm.n), cell.metrology)
    (cause,) = next(c.causes for c in found.channels if c.channel == "position")
    assert {p.name for p in cause.parameters} == set(truth)
    for parameter in cause.parameters:
        assert abs(parameter.value - truth[parameter.name]) < 3 * parameter.std


def test_a_curve_that_is_linear_over_the_regions_is_judged_anew_as_a_line(tmp_path) -> None:
    """As a line its value depends on an angle: part of an unknown effect."""
    truth = make_case("mixed:3", 1630002, tmp_path)
    cell = load_cell(tmp_path / "cell.yaml")
    found = diagnose(cell.model, read_log(tmp_path / "log.csv", cell.arm.n), cell.metrology)
    (channel,) = [c for c in found.channels if c.channel == "position"]
    assert {c.effect for c in channel.causes} == set(truth.effects)
    assert channel.structured
