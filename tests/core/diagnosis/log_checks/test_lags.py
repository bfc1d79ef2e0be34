"""Torques and wrenches on another clock than the joint angles are reported."""

from __future__ import annotations

from collections.abc import Mapping

import moving_truth as truth
import numpy as np
import pytest

from gapbridge.bridge.document.log_findings import log_finding_text
from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.log_checks.lags import lag_findings
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model

STEP = 0.02  # s
COULOMB = 4.0  # Nm
LOAD = 3.0  # kg


@pytest.fixture(scope="module")
def moving(tmp_path_factory) -> tuple[Model, dict[str, Array]]:
    """Return an arm of Pinocchio's with 6 joints, and 40 s of its motion with friction."""
    plant = truth.plant(tmp_path_factory.mktemp("arm"), 6, 1)
    course, time = truth.course(6, 3), np.arange(0, 40, STEP)
    q, qd, qdd = (course.at(time, order) for order in range(3))
    torque, wrench = plant.dynamics(q, qd, qdd, payload=np.full(len(q), LOAD))[:2]
    rng = np.random.default_rng(6)
    torque = torque + COULOMB * np.sign(qd) + 2 * qd + 0.4 + rng.normal(0, 0.3, torque.shape)
    wrench = wrench + np.repeat([2.0, 0.2], 3) + rng.normal(0, 0.1, wrench.shape)
    return plant.model(LOAD), {
        "timestamp": time, "actual_q": q, "actual_qd": qd, "actual_current_as_torque": torque,
        "ft_raw_wrench": wrench,
    }  # fmt: skip


def reported(model: Model, columns: Mapping[str, Array]) -> list[str]:
    return [log_finding_text(finding) for finding in lag_findings(model, log_of(columns))]


def log_of(columns: Mapping[str, Array]) -> Log:
    return truth.log_of(6, **columns)


@pytest.mark.parametrize("name", ["actual_current_as_torque", "ft_raw_wrench"])
@pytest.mark.parametrize(("rows", "told"), [(5, "0.10 s after"), (-10, "0.20 s before")])
def test_readings_that_come_late_or_early_are_reported(moving, name, rows, told):
    """By 0.1 s: frictions 10 to 80 % off, with standard deviations of 15 %."""
    model, columns = moving
    moved = columns | {name: np.roll(columns[name], rows, axis=0)}
    said = f"{name}_* seems to come about {told} the joint angles; expected both on one clock"
    assert reported(model, moved) == [said]


@pytest.mark.parametrize("rows", [0, 1])
def test_readings_in_time_are_not_suspected(moving, rows):
    """Nor those of a drive that filters them for 0.02 s."""
    model, columns = moving
    names = ("actual_current_as_torque", "ft_raw_wrench")
    moved = columns | {name: np.roll(columns[name], rows, axis=0) for name in names}
    assert reported(model, moved) == []


def test_friction_that_builds_up_after_a_reversal_is_no_lag(moving):
    """It comes late by the way that a gear winds up: 0.02 rad here, at slow joints 0.3 s."""
    model, columns = moving
    q, state = columns["actual_q"], np.zeros(6)
    friction = np.zeros_like(q)
    for row, way in enumerate(np.diff(q, axis=0), start=1):
        state = np.clip(state + way / 0.02 * (1 - state * np.sign(way)), -1, 1)
        friction[row] = 3 * COULOMB * state
    plain = COULOMB * np.sign(columns["actual_qd"])
    torque = columns["actual_current_as_torque"] - plain + friction
    assert reported(model, columns | {"actual_current_as_torque": torque}) == []


def test_what_is_no_recording_of_a_motion_has_no_lag(moving):
    model, columns = moving
    late = columns | {name: np.roll(columns[name], 5, axis=0) for name in columns if "t" in name}
    poses = {name: values[::25] for name, values in late.items()}
    assert reported(model, poses | {"timestamp": 30.0 * np.arange(len(poses["actual_q"]))}) == []
    assert reported(model, {k: v for k, v in columns.items() if k != "timestamp"}) == []
    backward = columns | {"timestamp": columns["timestamp"][::-1]}
    assert reported(model, backward) == []
    assert reported(model, {name: values[:40] for name, values in columns.items()}) == []
