"""Further effects are offered where the fit's own poses support them, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.blind.arms import ARMS
from benchmarks.calibration import laid_out
from benchmarks.calibration.drawings import model_of, real_arm
from gapbridge.core.calibration.fit import fit_session
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.parameters import DEFAULT, Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.result import Estimate
from gapbridge.core.calibration.summary import unsupported
from gapbridge.core.metrology import Metrology

KIND = ARMS["cobot10"]
EFFECTS = ("joint_offset", "axial_compliance")


def session(
    poses: int, seed: int, effects: tuple[str, ...] = EFFECTS
) -> tuple[Readings, Parameters]:
    """Return a small session of an arm that has nothing but what is fitted."""
    layout = laid_out.Layout(poses=poses, held_out=8, repeated=0)
    model = model_of(real_arm(KIND))
    parameters = identifiable_parameters(model, effects, observable=make_observable("position"))
    rng = np.random.default_rng(seed)
    truth = laid_out.draw_values(KIND, parameters.names, rng)
    laid, instrument = (
        laid_out.lay_out(KIND, layout, rng),
        laid_out.instrument_for(KIND, layout, rng),
    )
    return laid_out.readings_of(laid_out.arm_with(KIND, truth), laid, instrument, rng), parameters


@pytest.mark.slow
@pytest.mark.parametrize(("poses", "effects"), [(4, DEFAULT), (8, EFFECTS), (14, EFFECTS)])
def test_an_arm_without_further_effects_is_offered_none(
    poses: int, effects: tuple[str, ...]
) -> None:
    for seed in range(3):
        readings, parameters = session(poses, seed, tuple(effects))
        assert fit_session(readings, parameters, Metrology(False, 2e-5)).missing == ()


def test_what_is_chosen_does_not_depend_on_the_held_out_readings() -> None:
    readings, parameters = session(14, 1)
    value = readings.value.copy()
    value[readings.held_out] += 1.0
    one, other = (
        fit_session(r, parameters, Metrology(False, 2e-5))
        for r in (readings, replace(readings, value=value))
    )
    np.testing.assert_array_equal(one.state.values, other.state.values)
    assert one.missing == other.missing


@pytest.mark.parametrize(
    ("value", "std", "bound", "fallen"),
    [(1.35e-4, 2.72e-4, False, True), (9e-4, 2.72e-4, False, False), (9e-4, 2.72e-4, True, True)],
)
def test_an_effect_falls_that_its_own_value_does_not_bear_out(
    value: float, std: float, bound: bool, fallen: bool
) -> None:
    found = (
        Estimate("backlash_5", value, std, "rad", on_bound=bound),
        Estimate("backlash_50", 1.0, 0.1, "rad"),
    )
    assert unsupported(found, ("backlash_5",)) == (("backlash_5",) if fallen else ())
