"""What is asked before arming: whether the model corrects anything, and what the controller has."""

from __future__ import annotations

import numpy as np
import pytest

from gapbridge.bridge.loop.loop import ModelCheck
from gapbridge.core.arm import arm_from_dh, builtin_arm
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.drivers.rate_check import GAPS, RateCheck

SOFT = [1e-6] * 6
PULL = Loads(wrench=np.array([[0.0, 0.0, -30.0, 0.0, 0.0, 0.0]]))


@pytest.mark.parametrize("use_force", [True, False])
def test_a_model_without_effects_corrects_nothing(use_force: bool) -> None:
    assert not ModelCheck(Model(builtin_arm("ur10e")), use_force).corrects(PULL)


def test_a_model_with_compliance_corrects() -> None:
    model = Model(builtin_arm("ur10e")).with_compliance(SOFT, SOFT)
    assert ModelCheck(model, False).corrects(Loads())


def test_compliance_under_which_nothing_weighs_corrects_only_where_force_counts() -> None:
    rows = [
        {"a": 0.3, "alpha": (-1) ** i * np.pi / 2, "d": 0.1} for i in range(6)
    ]  # no masses, no payload
    model = Model(arm_from_dh(rows)).with_compliance(SOFT, SOFT)
    assert not ModelCheck(model, False).corrects(Loads())
    assert ModelCheck(model, True).corrects(Loads())


def test_what_is_known_is_tried_anew_when_asked() -> None:
    rows = [{"a": 0.3, "alpha": (-1) ** i * np.pi / 2, "d": 0.1} for i in range(6)]
    check = ModelCheck(Model(arm_from_dh(rows)).with_compliance(SOFT, SOFT), False)
    loaded = Loads(payload_mass=np.array([3.0]), payload_cog=np.zeros((1, 3)))
    assert not check.corrects(Loads())
    assert not check.corrects(loaded)  # remembered
    check.reset()
    assert check.corrects(loaded)


def states(rate: float, count: int, late: int = 0) -> list[float]:
    """Return times of states, every third ``late`` cycles late."""
    return [(k + (late if k % 3 == 0 else 0)) / rate for k in range(count)]


def test_a_rate_above_the_controllers_is_reported_by_name() -> None:
    check = RateCheck(500.0)
    for at in states(125.0, 40):
        check.take(at)
    assert check.known
    assert check.problem.startswith("link.rate: found 500 Hz, expected at most 125 Hz")


@pytest.mark.parametrize("late", [0, 1])
@pytest.mark.parametrize("own", [500.0, 505.0])
def test_the_controllers_own_rate_is_fine_however_many_states_were_missed(
    own: float, late: int
) -> None:
    check = RateCheck(500.0)
    for at in states(own, 40, late):
        check.take(at)
    assert check.problem == ""


def test_a_rate_is_known_after_a_few_states() -> None:
    check = RateCheck(500.0)
    for at in states(500.0, GAPS):
        check.take(at)
    assert not check.known
    check.take(1.0)
    assert check.known
