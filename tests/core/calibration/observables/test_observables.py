"""Every kind of reading: what it says, how it changes, and where its unknowns begin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from gapbridge.core.arm import builtin_arm
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import OBSERVABLES, make_observable
from gapbridge.core.calibration.observables.fixed_point import fixed_at, point_of
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.observables.predicted_readings import (
    predicted_readings,
    typical_nuisance,
    unmeasured_readings,
)
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.errors import ExcitationError, InputError
from gapbridge.core.estimation.registration import Registration
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix

Array = NDArray[np.float64]
OPTIONS = {"distance": [{}, {"zeroed": True}], "sphere": [{}, {"radius": 0.05}]}
KINDS = [(kind, options) for kind in OBSERVABLES for options in OPTIONS.get(kind, [{}])]


@pytest.fixture(scope="module")
def model() -> Model:
    tool = np.eye(4)
    tool[:3, 3] = [0.03, 0.02, 0.18]
    return Model(builtin_arm("ur5e"), tool)


def two_places(
    model: Model, observable: Observable, count: int = 60, seed: int = 1
) -> tuple[Readings, Nuisance]:
    """Return exact readings from two places of the instrument, of two targets."""
    random = np.random.default_rng(seed)
    q = random.uniform(-2.5, 2.5, (count, 6))
    half = np.arange(count) % 2
    readings = unmeasured_readings(
        observable.kind, q, Loads(payload_mass=random.choice([0.0, 4.0], count)),
        station=half, target=(np.arange(count) // 2) % 2,
    )  # fmt: skip
    nuisance = typical_nuisance(model, observable, readings, seed)
    if not observable.unknown and not observable.registered:
        frames = tuple(
            Registration(rotation_matrix(random.normal(size=3)), random.normal(size=3))
            for _ in range(2)
        )
        nuisance = replace(nuisance, stations=frames)
    return predicted_readings(observable, model, readings, nuisance), nuisance


@pytest.mark.parametrize(("kind", "options"), KINDS)
def test_exact_readings_leave_no_residual_at_the_truth(model, kind, options) -> None:
    observable = make_observable(kind, **options)
    readings, nuisance = two_places(model, observable)
    assert len(readings) > 30
    assert readings.value.shape == (len(readings), observable.width)
    gap = observable.residual(model, readings, nuisance)
    assert gap.shape == (len(readings), observable.equations)
    assert np.abs(gap).max() < 1e-9


@pytest.mark.parametrize(("kind", "options"), KINDS)
def test_columns_foretell_how_the_residual_changes(model, kind, options) -> None:
    observable = make_observable(kind, **options)
    readings, nuisance = two_places(model, observable)
    parameters = identifiable_parameters(model, observable=observable)
    random = np.random.default_rng(2)
    size = observable.layout(readings).size
    J, F = observable.columns(parameters, parameters.begin, readings, nuisance)
    step = 1e-3 * random.normal(size=len(parameters)) * parameters.scales
    other = 1e-6 * random.normal(size=size)
    moved = nuisance.moved(other, observable.layout(readings))
    changed = observable.residual(parameters.model(parameters.begin + step), readings, moved)
    before = observable.residual(model, readings, nuisance)
    foretold = before - (J @ step + F @ other).reshape(before.shape)
    assert np.abs(changed - before).max() > 1e-7
    assert np.abs(changed - foretold).max() < 1e-3 * np.abs(changed - before).max()


@pytest.mark.parametrize(("kind", "options"), KINDS)
def test_jacobians_are_differences_of_the_gap(model, kind, options) -> None:
    observable = make_observable(kind, **options)
    readings, nuisance = two_places(model, observable)
    poses = model.predict(readings.q, readings.loads)
    found = observable.jacobian(poses, readings, nuisance)
    expected = Observable.jacobian(observable, poses, readings, nuisance)
    assert found.shape == (len(readings), observable.equations, 6)
    assert np.abs(found).max() > 0.1
    assert np.abs(found - expected).max() < 1e-8


@pytest.mark.parametrize(("kind", "options"), KINDS)
def test_start_finds_instruments_and_targets_among_outlier_readings(model, kind, options) -> None:
    observable = make_observable(kind, **options)
    readings, nuisance = two_places(model, observable, 120)
    if observable.width:
        value = readings.value.copy()
        value[::17, :3] += 0.4
        readings = replace(readings, value=value)
    found = observable.start(model, readings)
    inlier = np.ones(len(readings), dtype=bool)
    inlier[::17] = not observable.width
    gap = observable.residual(model, readings, found)[inlier]
    assert np.abs(gap).max() < 1e-6
    if observable.unknown:
        for one, other in zip(found.stations, nuisance.stations, strict=True):
            assert point_of(one) == pytest.approx(point_of(other), abs=1e-6)


@pytest.mark.parametrize("kind", ["position", "pose"])
def test_a_registered_instrument_has_no_frame_to_find(model, kind) -> None:
    observable = make_observable(kind, registered=True)
    readings, _ = two_places(model, observable)
    assert observable.layout(readings).size == 3  # the second target alone
    assert make_observable(kind).layout(readings).size == 15


def test_a_sphere_is_touched_where_the_arm_is_brought(model) -> None:
    observable = make_observable("sphere", radius=0.04)
    nuisance = replace(Nuisance.zero(), stations=(fixed_at(np.array([0.5, 0.2, 0.3])),))
    nuisance = replace(nuisance, lengths=np.array([0.04]))
    q = np.random.default_rng(3).uniform(-2.5, 2.5, (40, 6))
    readings = predicted_readings(
        observable, model, unmeasured_readings("sphere", q, Loads()), nuisance
    )
    assert len(readings) > 20
    tip = model.predict(readings.q).position
    assert np.linalg.norm(tip - [0.5, 0.2, 0.3], axis=1) == pytest.approx(0.04, abs=1e-8)


def test_two_ball_readings_show_nothing_of_the_tools_place(model) -> None:
    observable = make_observable("relative")
    readings, nuisance = two_places(model, observable)
    shifted = replace(model, tool_in_flange=model.tool_in_flange.copy())
    shifted.tool_in_flange[:3, 3] += 0.1
    assert np.abs(observable.residual(shifted, readings, nuisance)).max() < 1e-9


def test_too_few_readings_are_declined_with_the_number_that_is_needed(model) -> None:
    observable = make_observable("position")
    readings, _ = two_places(model, observable)
    with pytest.raises(ExcitationError, match="position readings: found 2, expected at least 5"):
        observable.start(model, readings[np.arange(0, 4, 3)])


def test_an_unknown_kind_names_the_nearest() -> None:
    with pytest.raises(InputError, match=r"'positon'.*did you mean 'position'"):
        make_observable("positon")
