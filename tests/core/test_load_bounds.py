"""Bounds of live loads are the arm's own, and absurd loads are outside of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gapbridge.core.arm import arm_from_dh, builtin_arm, builtin_names
from gapbridge.core.load_bounds import (
    DEFAULT_RATED,
    FORCE_FACTOR,
    GRAVITY,
    LEVER,
    PAYLOAD_FACTOR,
    LoadBounds,
)
from gapbridge.core.model import Model

COG = np.array([0.0, 0.0, 0.05])


@pytest.mark.parametrize("name", builtin_names())
def test_a_built_in_arm_has_bounds_from_its_rated_payload(name: str) -> None:
    arm = builtin_arm(name)
    bounds = LoadBounds.of(Model(arm))
    assert np.isfinite(arm.payload)
    assert bounds.mass == pytest.approx(1.5 * arm.payload)
    assert bounds.payload_problem(arm.payload, COG) is None
    assert bounds.payload_problem(1.5 * arm.payload, COG) is None
    assert bounds.wrench_problem(np.array([0, 0, -1.5 * GRAVITY * arm.payload, 0, 0, 0])) is None
    assert "payload: found" in (bounds.payload_problem(1.51 * arm.payload, COG) or "")
    strongest = FORCE_FACTOR * GRAVITY * arm.payload
    assert "force: found" in (bounds.wrench_problem(np.array([1.01 * strongest] + [0] * 5)) or "")
    twisted = np.array([0, 0, 0, 1.01 * LEVER * strongest, 0, 0])
    assert "torque: found" in (bounds.wrench_problem(twisted) or "")


@pytest.mark.parametrize("mass", [40.0, 400.0, -0.1, np.nan, np.inf])
def test_what_a_ur5e_cannot_carry_is_rejected(mass: float) -> None:
    found = LoadBounds.of(Model(builtin_arm("ur5e"))).payload_problem(mass, COG)
    assert found is not None
    assert "expected 0 to 7.5 kg (rated payload 5 kg)" in found


def test_a_small_mass_far_out_is_rejected_as_a_moment() -> None:
    bounds = LoadBounds.of(Model(builtin_arm("ur5e")))
    assert bounds.payload_problem(2.0, np.array([0, 0, 1.0])) is None
    assert "kg m" in (bounds.payload_problem(3.0, np.array([0, 0, 1.0])) or "")
    assert "kg m" in (bounds.payload_problem(3.0, np.array([0, 0, np.nan])) or "")


@pytest.mark.parametrize("value", [9000.0, np.nan])
def test_nine_kilonewtons_are_rejected_on_every_arm(value: float) -> None:
    for name in builtin_names():
        bounds = LoadBounds.of(Model(builtin_arm(name)))
        assert bounds.wrench_problem(np.array([0, 0, value, 0, 0, 0])) is not None


def test_an_arm_of_unknown_rating_gets_the_documented_default() -> None:
    rows = [{"a": 0.4, "alpha": 0.0, "d": 0.1, "mass": 3.0} for _ in range(6)]
    heavy = arm_from_dh(rows)
    assert LoadBounds.of(Model(heavy)).rated == pytest.approx(9.0)
    light = arm_from_dh([{**row, "mass": 0.0} for row in rows])
    assert LoadBounds.of(Model(light)).rated == DEFAULT_RATED
    assert LoadBounds.of(Model(light, payload_mass=30.0)).rated == 30.0
    reported = replace(light, payload=2.0)
    assert LoadBounds.of(Model(reported, payload_mass=2.5)).mass == pytest.approx(
        PAYLOAD_FACTOR * 2.0
    )
