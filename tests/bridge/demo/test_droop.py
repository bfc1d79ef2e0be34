"""An arm with yielding servos: diagnosed from static measurements, compensated in its setpoints."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gapbridge.core.arm import builtin_arm
from gapbridge.core.compensation import Compensator
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.drivers.simulated.plant.plant import Plant
from gapbridge.drivers.simulated.plant.plant_arm import plant_arm
from gapbridge.drivers.simulated.plant.plant_settings import draw_plant_settings

ARM = builtin_arm("ur3e")
DROOP = (0.0, 1.6e-4, 3e-4, 1.5e-3, 1e-3, 0.0)  # rad/Nm: some 5 mrad where the arm is stretched out
PERIOD = 0.005  # s, of the CAN demo's link
SETTLING_CYCLES = 250  # after which the arm is at rest
LOAD, COG = 2.0, (0.02, 0.01, 0.06)


def plant() -> Plant:
    arm = plant_arm(ARM)
    settings = replace(
        draw_plant_settings(arm, 3), axial=(0.0,) * 6, radial=(0.0,) * 6, droop=DROOP,
        payload_mass=LOAD, payload_cog=COG,
    )  # fmt: skip
    return Plant(arm, settings, POSES[0])


def poses(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([0.0, -0.9, 1.2, -1.0, -1.3, 0.0]) + rng.uniform(-0.7, 0.7, (count, 6))


POSES = poses(40, 1)


def settled_joints(arm: Plant, setpoints: np.ndarray) -> np.ndarray:
    """Return the joints at rest (N, n), rad, for setpoints (N, n), rounded to encoder counts."""
    found = []
    for q in setpoints:
        for _ in range(SETTLING_CYCLES):
            arm.step(tuple(q), PERIOD)
        found.append(arm.q)
    return np.round(np.array(found) / 1.7e-5) * 1.7e-5


@pytest.mark.slow
def test_droop_is_identified_and_its_compensation_removes_the_joint_error() -> None:
    nominal = Model(ARM, payload_mass=LOAD, payload_cog=np.array(COG))
    before = settled_joints(plant(), POSES)
    log = Log("measurements.csv", {"target_q": POSES, "actual_q": before}, 6)
    (channel,) = [c for c in diagnose(nominal, log).channels if c.channel == "tracking"]
    (cause,) = channel.causes
    assert (cause.effect, cause.joints) == ("servo_droop", (2, 3, 4, 5))
    for reported in cause.parameters:
        true = DROOP[int(reported.name.rpartition("_")[2]) - 1]
        assert reported.std is not None
        assert abs(reported.value - true) < max(4 * reported.std, 0.01 * true)
    live = Compensator(nominal.with_terms(cause.terms))
    wanted = poses(15, 2)
    plain = np.abs(settled_joints(plant(), wanted) - wanted)
    setpoints = np.array([live.correct(q).q for q in wanted])
    corrected = np.abs(settled_joints(plant(), setpoints) - wanted)
    assert plain.max() > 4e-3
    ratio = np.sqrt(np.mean(plain**2)) / np.sqrt(np.mean(corrected**2))
    assert ratio > 20, ratio
