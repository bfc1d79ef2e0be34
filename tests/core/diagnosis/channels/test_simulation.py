"""The user's own simulator in place of the model: what it knows is no gap any more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small

from gapbridge.core.diagnosis.all_rows import long_recording
from gapbridge.core.diagnosis.channels import torque, tracking
from gapbridge.core.diagnosis.channels.position import observe
from gapbridge.core.diagnosis.channels.simulation import (
    COLUMN_OF_CHANNEL,
    Observe,
    joined,
    predicted_by,
)
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.effects import Site, Term
from gapbridge.core.errors import LogError
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.rotation import rotation_matrix, rotation_vector

METROLOGY = Metrology(registered=True, sigma=small.SIGMA)
SESSION = small.session_of(0)
BOTH = replace(
    small.REAL["backlash"], tool_position=small.REAL["tool_frame"].tool_position
)  # a tool that stands elsewhere, and a joint with play


def simulated(real) -> Log:
    """Return what a simulator of this arm says, row by row."""
    return Log("sim.csv", {"measured_position": small.stand(real, SESSION).tcp}, 3)


def log_of(real) -> Log:
    return small.log_of(SESSION, small.readings(real, SESSION))


def causes_of(real, simulator):
    found = diagnose(small.model_of(), log_of(real), METROLOGY, simulated=simulated(simulator))
    return [c.effect for c in found.channels[0].causes], found


def test_a_simulator_that_knows_everything_leaves_no_gap():
    named, found = causes_of(BOTH, BOTH)
    assert (named, found.verdict) == ([], "no_gap")
    assert found.channels[0].gap_rms == pytest.approx(small.FLOOR, rel=0.15)


def test_only_what_the_simulator_does_not_know_is_a_cause():
    named, found = causes_of(BOTH, small.REAL["tool_frame"])
    assert named == ["backlash"]
    (reported,) = found.channels[0].causes[0].parameters
    assert abs(reported.value - 9e-4) < 4 * reported.std


def test_a_simulator_that_predicts_what_the_model_predicts_changes_nothing():
    named, found = causes_of(small.REAL["backlash"], small.NOMINAL)
    plain = small.diagnosed("backlash")
    assert named == ["backlash"]
    assert found.channels[0].gap_rms == pytest.approx(plain.channels[0].gap_rms)
    mine, theirs = (f.channels[0].causes[0].parameters[0].value for f in (found, plain))
    assert mine == pytest.approx(theirs, rel=1e-4)


def test_an_effect_changes_the_simulators_values_as_it_changes_the_models():
    log, term = log_of(small.NOMINAL), Term("joint_offset", Site(2), (0.01,))
    observation = predicted_by("position", observe)(
        small.model_of(), joined(log, simulated(BOTH)), METROLOGY
    )
    own = observe(small.model_of(), log, METROLOGY)
    assert np.array_equal(observation.predict(()), simulated(BOTH).require("measured_position"))
    change = observation.predict([term]) - observation.predict(())
    assert np.allclose(change, own.predict([term]) - own.predict(()))
    assert np.abs(change).max() > 1e-3


TURN = (0.0, 0.0, 0.0, 2e-3, -1e-3, 3e-3)  # rad, of a tool that the model does not know


@pytest.mark.parametrize("registered", [True, False])
@pytest.mark.parametrize("has_rotation", [True, False])
def test_rotations_are_compared_with_the_simulators(registered, has_rotation):
    """The simulator knows how the tool is turned; if it has no rotations none are compared."""
    model, rng = small.model_of(), np.random.default_rng(5)
    turned = model.with_terms([Term("tool_frame", Site(), TURN)])
    pose = turned.predict(SESSION.q, log_of(small.NOMINAL).loads())
    measured = {"measured_position": pose.position, "measured_rotation": rotation_vector(
        pose.rotation)}  # fmt: skip
    simulator = dict(measured) if has_rotation else {"measured_position": pose.position}
    if not registered:
        frame = rotation_matrix(np.array([[0.3, -0.8, 1.2]]))[0]
        measured["measured_position"] = pose.position @ frame.T + [2.0, -1.0, 0.0]
        measured["measured_rotation"] = rotation_vector(frame @ pose.rotation)
    noisy = {k: v + rng.normal(0, 2e-5, v.shape) for k, v in measured.items()}
    log = small.log_of(SESSION, noisy.pop("measured_position"), **noisy)
    metrology = Metrology(registered=registered, sigma=2e-5)
    found = diagnose(model, log, metrology, simulated=Log("sim.csv", simulator, 3))
    assert found.verdict == "no_gap"
    assert found.channels[0].gap.shape[1] == (6 if has_rotation else 3)
    assert np.abs(found.channels[0].gap).max() < 2e-4


def test_rows_stay_together_where_some_have_no_reading():
    log = log_of(small.NOMINAL)
    read = log.require("measured_position").copy()
    read[[0, 7]] = np.nan
    log = replace(log, columns={**log.columns, "measured_position": read})
    observation = predicted_by("position", observe)(
        small.model_of(), joined(log, simulated(small.NOMINAL)), METROLOGY
    )
    assert len(observation.measured) == 58
    assert np.abs(observation.measured - observation.predict(())).max() < 5 * small.FLOOR


@pytest.mark.parametrize(
    ("columns", "phrase"),
    [
        ({"measured_position": np.zeros((4, 3))}, "sim.csv: found 4 rows, expected 60"),
        ({"payload": np.zeros(60)}, "found no prediction, expected one of measured_position_0"),
        ({"measured_position": np.full((60, 3), np.nan)}, "sim.csv: row 2, .* found nothing"),
    ],
)
def test_a_simulators_log_that_does_not_fit_is_refused(columns, phrase):
    with pytest.raises(LogError, match=phrase):
        diagnose(small.model_of(), log_of(BOTH), METROLOGY, simulated=Log("sim.csv", columns, 3))


def test_a_channel_that_the_simulator_lacks_is_not_observable():
    wrench = np.random.default_rng(0).normal(size=(60, 6))
    log = log_of(small.NOMINAL)
    log = replace(log, columns={**log.columns, "ft_raw_wrench": wrench})
    found = diagnose(small.model_of(), log, METROLOGY, simulated=simulated(small.NOMINAL))
    (hidden,) = [h for h in found.not_observable if h.channel == "wrench"]
    assert hidden.needs == ("ft_raw_wrench (in the simulator's log)",)


def moving_log(seed: int = 0) -> Log:
    """Return two seconds of motion with all that the moving channels need."""
    rng = np.random.default_rng(seed)
    t = np.arange(400) * 5e-3
    target = 0.3 * np.sin(2 * np.pi * (0.4 * t[:, None] + rng.uniform(size=3)))
    return Log(
        "log.csv",
        {"timestamp": t, "target_q": target, "actual_q": target + rng.normal(0, 1e-5, target.shape),
         "actual_current_as_torque": rng.normal(0, 1, target.shape)}, 3,
    )  # fmt: skip


@pytest.mark.parametrize("channel", ["torque", "tracking"])
def test_a_search_over_fewer_rows_keeps_the_simulators_prediction(channel: str):
    log = moving_log()
    name = COLUMN_OF_CHANNEL[channel]
    simulator = Log("sim.csv", {name: log.require(name) + 0.05}, 3)
    observers = {"torque": torque.observe, "tracking": tracking.observe}
    observation = predicted_by(channel, observers[channel])(
        small.model_of(), joined(log, simulator), METROLOGY
    )
    take = np.arange(0, len(observation.rows), 3)
    assert observation.subset is not None
    subset = observation.subset(take)
    assert np.allclose(subset.predict(()), simulator.require(name)[observation.rows[take]])


def test_a_delay_is_in_series_with_the_simulated_servo():
    """The simulator comes 30 ms late of itself, the real arm 20 ms later still."""
    log, late, own = moving_log(), 0.02, 0.03
    t = log.require("timestamp")
    command = log.require("target_q")

    def shifted(by: float) -> np.ndarray:
        return np.column_stack([np.interp(t - by, t, command[:, j]) for j in range(3)])

    simulator = Log("sim.csv", {"actual_q": shifted(own)}, 3)
    observation = predicted_by("tracking", tracking.observe)(
        small.model_of(), joined(log, simulator), METROLOGY
    )
    found = observation.predict([Term("latency", Site(1), (late,))])[:, 0]
    assert np.abs(found - shifted(own + late)[observation.rows, 0]).max() < 2e-4
    assert (
        np.abs(shifted(own)[observation.rows, 0] - shifted(own + late)[observation.rows, 0]).max()
        > 1e-2
    )


def test_a_block_of_a_long_log_keeps_its_motion_behind_the_simulator(monkeypatch):
    """Cycles recorded twice, all in one block: too many there, few in the whole recording."""
    monkeypatch.setattr(long_recording, "WHOLE", 3000)
    count = 6000
    t = np.arange(count) * 5e-3
    t[1000:1040:2] = t[1001:1041:2]
    target = 0.3 * np.sin(2 * np.pi * (0.4 * t[:, None] + np.array([0.0, 0.3, 0.6])))
    q = target + np.random.default_rng(0).normal(0, 1e-5, target.shape)
    log = Log("log.csv", {"timestamp": t, "target_q": target, "actual_q": q}, 3)
    behind = joined(log, Log("sim.csv", {"actual_q": target}, 3))
    observe = predicted_by("tracking", tracking.observe)

    def rows_of(log: Log, observe: Observe) -> list[int]:
        long = long_recording.long_recording(log)
        assert long is not None
        return [
            int(row) + block.first
            for block in long
            for row in observe(small.model_of(), block.log, METROLOGY).rows
            if row + block.first >= block.begin
        ]

    assert rows_of(behind, observe) == rows_of(log, tracking.observe)
