"""Mistakes are detected with the right explanation; good readings are not flagged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gapbridge.bridge.calibration.session.reading_check import (
    ReadingCheck,
    Verdict,
    check_without_fit,
)
from gapbridge.core.arm import builtin_arm
from gapbridge.core.calibration.parameters import DEFAULT
from gapbridge.core.calibration.plan import Payload
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.effects import Site, Term
from gapbridge.core.estimation.registration import Registration
from gapbridge.core.loads import Loads
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix

LOADS = (Payload(1.5, (0.0, 0.0, 0.05), "reflector"), Payload(9.5, (0.0, 0.0, 0.09), "plate"))
NOMINAL = Model(builtin_arm("ur10e"))
FRAME = Registration(rotation_matrix(np.array([0.1, -0.2, 1.0])), np.array([2.0, -1.0, 0.4]))
METROLOGY = Metrology(registered=False, sigma=2e-5)


def truth(seed: int) -> Model:
    rng = np.random.default_rng(seed)
    terms = [Term("joint_offset", Site(j), (float(rng.normal(0, 1e-3)),)) for j in range(1, 7)]
    soft = rng.uniform(1e-6, 2e-5, (2, 6))
    return NOMINAL.with_terms(terms).with_compliance(soft[0], soft[1] * 0.2)


def session(count: int, seed: int, registered: bool = False) -> Readings:
    """Return readings of a true arm, in an unknown frame unless ``registered``."""
    rng = np.random.default_rng((seed, 3))
    q = np.array([0, -1.5, 1.5, -1.8, -1.5, 0]) + rng.uniform(-0.9, 0.9, (count, 6))
    load = np.arange(count) % 2
    loads = Loads(
        payload_mass=np.array([LOADS[k].mass for k in load]),
        payload_cog=np.array([LOADS[k].cog for k in load]),
    )
    position = truth(seed).predict(q, loads).position
    if not registered:
        position = position @ FRAME.rotation.T + FRAME.position
    value = position + rng.normal(0, 5e-5, (count, 3))
    zero = np.zeros(count, dtype=np.int64)
    return Readings(
        "position", q, value, np.full(count, np.nan), loads, load, zero, zero,
        np.zeros(count, dtype=bool), np.arange(count),
    )  # fmt: skip


def check_last(
    readings: Readings, metrology: Metrology = METROLOGY, typed: bool = True, joints: bool = False
) -> Verdict:
    """Check the last of some readings against those before it."""
    check = ReadingCheck(NOMINAL, metrology, "position", metrology.sigma, DEFAULT, LOADS)
    last = np.arange(len(readings)) == len(readings) - 1
    return check.check(readings[~last], readings[last], typed, joints)


def with_last(readings: Readings, value: list[float] | np.ndarray) -> Readings:
    values = readings.value.copy()
    values[-1] = value
    return replace(readings, value=values)


@pytest.mark.parametrize("registered", [True, False])
def test_good_readings_are_not_rejected(registered: bool) -> None:
    metrology = replace(METROLOGY, registered=registered)
    check = ReadingCheck(NOMINAL, metrology, "position", 2e-5, DEFAULT, LOADS)
    verdicts = []
    for seed in range(3):
        readings = session(12, seed, registered)
        for k in range(12):
            rows = np.arange(12)
            verdicts.append(check.check(readings[rows < k], readings[rows == k], True, False))
    assert not any(v.implausible for v in verdicts)
    assert sum(np.isfinite(v.deviation) for v in verdicts) >= 3 * (12 if registered else 8)


@pytest.mark.parametrize(
    ("factor", "phrase"), [(1e3, "millimetres"), (1e-3, "metres"), (25.4, "25.4")]
)
def test_a_wrong_unit_is_named_and_put_right(factor: float, phrase: str) -> None:
    readings = session(10, 1)
    verdict = check_last(with_last(readings, readings.value[-1] * factor))
    assert verdict.implausible
    assert phrase in verdict.explanations[0]
    np.testing.assert_allclose(verdict.corrected, readings.value[-1])


def test_a_mistyped_coordinate_is_named() -> None:
    readings = session(12, 2)
    wrong = readings.value[-1].copy()
    wrong[1] += 0.09
    verdict = check_last(with_last(readings, wrong))
    assert verdict.implausible
    assert any(reason.startswith("y alone is off") for reason in verdict.explanations)


def test_exchanged_axes_and_a_lost_sign_are_named() -> None:
    readings = session(12, 3)
    x, y, z = readings.value[-1]
    assert any("z y x" in r for r in check_last(with_last(readings, [z, y, x])).explanations)
    assert any("sign of x" in r for r in check_last(with_last(readings, [-x, y, z])).explanations)


def test_a_load_that_was_not_changed_is_named() -> None:
    readings = session(40, 4)
    swapped = replace(readings.loads, payload_mass=readings.loads.payload_mass.copy())  # type: ignore[union-attr]
    assert swapped.payload_mass is not None
    swapped.payload_mass[-1] = LOADS[0].mass  # declared: reflector; it was the plate
    load = readings.load.copy()
    load[-1] = 0
    verdict = check_last(replace(readings, loads=swapped, load=load))
    assert verdict.implausible
    assert any("plate hangs on the flange" in reason for reason in verdict.explanations)


def test_a_knocked_tracker_is_seen() -> None:
    readings = session(40, 5)
    verdict = check_last(with_last(readings, readings.value[-1] + [0.0015, -0.001, 0.002]))
    assert verdict.implausible
    assert 1e-3 < verdict.deviation < 4e-3
    assert verdict.limit < 1e-3


def test_a_mistyped_joint_is_named() -> None:
    readings = session(20, 6)
    q = readings.q.copy()
    q[-1, 2] += np.radians(10.0)
    verdict = check_last(replace(readings, q=q), typed=False, joints=True)
    assert verdict.implausible
    assert any("joint 3" in reason for reason in verdict.explanations)


def test_the_first_readings_of_an_unregistered_instrument_show_nothing_yet() -> None:
    assert not np.isfinite(check_last(session(2, 0)).deviation)


@pytest.mark.parametrize("count", [1, 2, 3])
@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_the_first_three_readings_in_a_wrong_unit_are_doubted(count: int, factor: float) -> None:
    readings = session(count, 1)
    verdict = check_last(with_last(readings, readings.value[-1] * factor))
    assert verdict.implausible
    if count > 1:
        assert "millimetres" in " ".join(verdict.explanations)
        assert verdict.corrected == pytest.approx(readings.value[-1])


def test_a_second_reading_of_another_stop_is_doubted_by_the_first() -> None:
    readings = session(2, 1)
    verdict = check_last(with_last(readings, readings.value[0]))
    assert verdict.implausible
    assert "the joints put the two" in verdict.explanations[0]


def test_two_balls_keep_their_distance_and_a_gauge_moves_no_farther_than_the_arm() -> None:
    readings = session(2, 1)
    tip = NOMINAL.predict(readings.q, readings.loads).position
    balls = replace(readings, kind="relative", value=np.array([[0.2, 0, 0], [0, 0.21, 0]]))
    one, two = balls[np.array([0])], balls[np.array([1])]
    assert check_without_fit(one, two, tip) is not None
    assert check_without_fit(one, replace(two, value=np.array([[0, 0.2002, 0]])), tip) is None
    far = float(np.linalg.norm(tip[1] - tip[0]))
    gauge = replace(readings, kind="distance", value=np.array([[1.0], [1.0 + 2 * far + 0.1]]))
    assert check_without_fit(gauge[np.array([0])], gauge[np.array([1])], tip) is not None
    near = replace(gauge, value=np.array([[1.0], [1.0 + 0.5 * far]]))
    assert check_without_fit(near[np.array([0])], near[np.array([1])], tip) is None
