"""A tool that nobody declared, on a flange sensor: its mass, its centre and the sensor's zero."""

from __future__ import annotations

from dataclasses import replace

import moving_truth as truth
import numpy as np
import pytest

from gapbridge.core.diagnosis.diagnosis import diagnose

N, ROWS, MASS = 6, 80, 1.2
BIAS = np.array([-3.0, -5.0, -16.0, 0.01, -0.06, 0.005])
NOISE = np.repeat([0.1, 0.001], 3)
SIDEWAYS = (0.3, 0.2, 0.0)  # N: a cable that pulls a little, always the same way


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    return truth.plant(tmp_path_factory.mktemp("arm"), N, 1)


def diagnosed(plant, pull, withhold=()):
    """Return the wrench channel of poses with a load and a pull that the cell does not know."""
    q, force = truth.poses(N, ROWS, 5), np.zeros((ROWS, 6))
    force[:, :3] = pull
    wrench = plant.dynamics(q, 0 * q, 0 * q, force, np.full(ROWS, MASS))[1] + BIAS
    wrench += np.random.default_rng(3).normal(0, 1, wrench.shape) * NOISE
    log = truth.log_of(N, timestamp=np.arange(ROWS) * 20.0, actual_q=q, ft_raw_wrench=wrench)
    model = replace(plant.model(0.0), payload_cog=np.zeros(3))
    found = diagnose(model, log, withhold=withhold)
    return next(c for c in found.channels if c.channel == "wrench")


@pytest.mark.parametrize("pull", [(0.0, 0.0, 0.0), SIDEWAYS])
def test_an_undeclared_load_is_found_with_its_centre_and_the_zero(plant, pull):
    """A pull that points nearly down is no reason to take a weight back."""
    found = {c.effect: c.terms[0].values for c in diagnosed(plant, pull).causes}
    assert {*found} == {"payload", "payload_cog", "ft_bias"}
    assert found["payload"][0] == pytest.approx(MASS, rel=0.01)
    assert np.allclose(found["payload_cog"], truth.COG, atol=1.5e-3)
    assert np.allclose(found["ft_bias"], BIAS, atol=0.1)


def test_a_load_lighter_than_the_log_declares_is_no_gain_of_the_sensor(plant):
    """The log's payload counts, also where it never changes and the cell holds another."""
    q, ones = truth.poses(N, ROWS, 5), np.ones(ROWS)
    wrench = plant.dynamics(q, 0 * q, 0 * q, payload=4.0)[1]
    wrench += np.random.default_rng(3).normal(0, 1, wrench.shape) * NOISE
    log = truth.log_of(
        N, timestamp=np.arange(ROWS) * 20.0, actual_q=q, ft_raw_wrench=wrench, payload=5.0 * ones,
        payload_cog=ones[:, None] * truth.COG,
    )  # fmt: skip
    found = next(c for c in diagnose(plant.model(0.0), log).channels if c.channel == "wrench")
    assert [c.effect for c in found.causes] == ["payload"]
    assert found.causes[0].terms[0].values[0] == pytest.approx(-1.0, abs=0.02)


@pytest.mark.parametrize("seed", [0, 2, 5])
def test_an_undeclared_load_is_found_by_a_sensor_whose_gains_differ(plant, seed):
    """Beside the load found, a mass anywhere at the tool explains the gains no better than it."""
    rng, q = np.random.default_rng(seed), truth.poses(N, ROWS, 5)
    weight = plant.dynamics(q, 0 * q, 0 * q, payload=MASS)[1]
    wrench = weight * (1 + rng.uniform(-0.03, 0.03, 6)) + BIAS
    wrench += rng.normal(0, 1, wrench.shape) * NOISE
    log = truth.log_of(N, timestamp=np.arange(ROWS) * 20.0, actual_q=q, ft_raw_wrench=wrench)
    found = next(c for c in diagnose(plant.model(0.0), log).channels if c.channel == "wrench")
    (load,) = (c.terms[0].values[0] for c in found.causes if c.effect == "payload")
    assert load == pytest.approx(MASS, rel=0.03)
    assert found.remaining_rms_held_out < 0.1 * found.gap_rms


def test_no_centre_is_accused_of_a_load_that_is_not(plant):
    channel = diagnosed(plant, SIDEWAYS, ("payload",))
    assert "payload_cog" not in [c.effect for c in channel.causes]


def test_structure_is_never_nothing(plant):
    channel = diagnosed(plant, SIDEWAYS)
    assert channel.structured
    assert channel.noise_floor_rms is None
    assert 0 < channel.unexplained_rms < channel.remaining_rms


def test_a_sensor_that_says_one_thing_for_ever_is_answered(plant):
    """A mocked sensor repeats itself to the last digit: no part of the log differs from another."""
    rows = np.ones((40, 1))
    log = truth.log_of(
        N, timestamp=np.arange(40) * 0.1, actual_q=rows * truth.poses(N, 1, 5),
        ft_raw_wrench=rows * [1.0, -2.0, -21.1, 0.1, 0.05, 0.0],
        payload=2.0 * rows[:, 0], payload_cog=rows * [0.0, 0.0, 0.05],
    )  # fmt: skip
    with np.errstate(divide="raise", over="raise", invalid="raise"):
        found = diagnose(plant.model(0.0), log)
    channel = next(c for c in found.channels if c.channel == "wrench")
    assert not channel.causes  # from one pose it may be a weight as well
    assert channel.verdict == "unexplained"
    assert np.isfinite([channel.gap_rms, channel.remaining_rms, channel.unexplained_rms]).all()
