"""A base that is not mounted as the cell says is reported, and currents or sizes for torques."""

from __future__ import annotations

from dataclasses import replace

import moving_truth as truth
import numpy as np
import pytest

from gapbridge.bridge.document.log_findings import log_finding_text
from gapbridge.core.diagnosis.log_checks.units_and_clocks import findings
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model

G = 9.80665
UPRIGHT, WALL, CEILING = [0, 0, -G], [G, 0, 0], [0, 0, G]


@pytest.fixture(scope="module")
def moving(tmp_path_factory) -> tuple[Model, dict[str, np.ndarray]]:
    """Return an upright arm of Pinocchio's with 7 joints, and a minute of its motion."""
    plant = truth.plant(tmp_path_factory.mktemp("arm"), 7, 1)
    course, time = truth.course(7, 3), np.arange(0, 60, 0.05)
    q, qd, qdd = (course.at(time, order) for order in range(3))
    torque = plant.dynamics(q, qd, qdd)[0] + 1.5 * np.sign(qd) + 0.4
    torque += np.random.default_rng(6).normal(0, 0.3, torque.shape)
    columns = {
        "timestamp": time, "actual_q": q, "actual_qd": qd, "actual_current_as_torque": torque,
    }  # fmt: skip
    return plant.model(), columns


def reported(model: Model, log: Log, gravity: list[float]) -> list[str]:
    found = findings(log, replace(model, gravity=np.array(gravity)))
    return [log_finding_text(finding) for finding in found]


def test_the_right_mounting_is_not_suspected(moving):
    model, columns = moving
    assert reported(model, truth.log_of(7, **columns), UPRIGHT) == []


@pytest.mark.parametrize("gravity", [WALL, CEILING], ids=["wall", "ceiling"])
@pytest.mark.parametrize("measured", ["actual_qd", None], ids=["with speeds", "without"])
def test_another_mounting_is_reported_with_the_direction_of_the_weights(moving, gravity, measured):
    model, columns = moving
    kept = {k: v for k, v in columns.items() if k != "actual_qd" or measured}
    (line,) = reported(model, truth.log_of(7, **kept), gravity)
    assert "weights that pull along [" in line
    along = np.array([float(x) for x in line.split("[")[1].split("]")[0].split(",")])
    assert along @ UPRIGHT > 0.97 * G * np.linalg.norm(along)  # the motion's own forces are in it


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [0.0, 3.0])
def test_torques_that_never_change_show_no_mounting(moving, value):
    """A recorder writes zeros where a controller gives nothing: no direction has no length."""
    model, columns = moving
    same = np.full_like(columns["actual_q"], value)
    log = truth.log_of(7, **{**columns, "actual_current_as_torque": same})
    assert not [line for line in reported(model, log, UPRIGHT) if "weights" in line]


def test_torques_of_the_wrong_sign_are_no_ceiling(moving):
    model, columns = moving
    turned = columns | {"actual_current_as_torque": -columns["actual_current_as_torque"]}
    (line,) = reported(model, truth.log_of(7, **turned), UPRIGHT)
    assert line.startswith("actual_current_as_torque seems to have the wrong sign;")


def test_a_few_rows_or_links_without_mass_show_no_mounting(moving):
    model, columns = moving
    few = {k: v[:20] for k, v in columns.items()}
    assert not [x for x in reported(model, truth.log_of(7, **few), WALL) if "weights" in x]
    massless = replace(model, arm=replace(model.arm, mass=np.zeros(7)))
    assert reported(massless, truth.log_of(7, **columns), WALL) == []


def test_torques_without_a_sign_are_reported(moving):
    model, columns = moving
    sizes = columns | {"actual_current_as_torque": np.abs(columns["actual_current_as_torque"])}
    line = reported(model, truth.log_of(7, **sizes), UPRIGHT)[0]
    assert line.startswith("actual_current_as_torque is never negative,")


def test_currents_are_reported_with_their_share_of_the_weights(moving):
    model, columns = moving
    currents = columns | {"actual_current_as_torque": columns["actual_current_as_torque"] / 12}
    (line,) = reported(model, truth.log_of(7, **currents), UPRIGHT)
    share = float(line.split("only ")[1].split()[0])
    assert share == pytest.approx(1 / 12, rel=0.3)
    assert line.endswith("it looks like currents (A), expected torques (Nm)")
