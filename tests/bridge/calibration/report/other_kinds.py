"""Calibrations from every kind of reading, made by simulation, for the tests of the report."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from gapbridge.core.arm import builtin_arm
from gapbridge.core.calibration.fit import evaluate_fit, fit_session
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.observables.predicted_readings import (
    predicted_readings,
    typical_nuisance,
    unmeasured_readings,
)
from gapbridge.core.calibration.result import Calibration
from gapbridge.core.effects import Site, Term
from gapbridge.core.loads import Loads
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

EFFECTS = ("joint_offset_2", "joint_offset_3", "joint_offset_4", "axial_compliance_2")
TRUE = (Term("joint_offset", Site(2), (6e-4,)), Term("joint_offset", Site(3), (-4e-4,)),
        Term("axial_compliance", Site(2), (1.5e-5,)))  # fmt: skip
COUNT, HELD_OUT, SIGMA = 36, 10, 2e-5


@cache
def calibration_of(kind: str) -> Calibration:
    """Return a calibration from readings of one kind."""
    tool = np.eye(4)
    tool[:3, 3] = 0.06, 0.02, 0.18
    nominal = Model(builtin_arm("ur10e"), tool_in_flange=tool)
    real, rng = nominal.with_terms(TRUE), np.random.default_rng(5)
    observable = make_observable(kind)
    q = np.array([0.4, -1.3, 1.6, -1.2, -1.5, 0.3]) + rng.uniform(-0.6, 0.6, (COUNT, 6))
    load = np.arange(COUNT) % 2
    mass = np.where(load == 1, 8.0, 1.0)
    pose = np.arange(COUNT) // 2
    # the second of each pair is the same pose under the other load; some come again
    q[1::2] = q[::2]
    pose[-6:], q[-6:], load[-6:], mass[-6:] = 0, q[0], 0, 1.0
    target = np.where(np.arange(COUNT) % 3 == 0, 2, 1) if kind == "relative" else 0 * pose
    loads = Loads(payload_mass=mass, payload_cog=np.zeros((COUNT, 3)))
    empty = unmeasured_readings(kind, q, loads, load=load, pose=pose, target=target)
    nuisance = typical_nuisance(real, observable, empty)
    readings = predicted_readings(observable, real, empty, nuisance)
    value = readings.value + rng.normal(0, SIGMA, readings.value.shape)
    hand = 0.0 if readings.value.shape[1] else 2e-5  # rad: what is touched is touched by hand
    readings = replace(
        readings, value=value, q=readings.q + rng.normal(0, 1.0, readings.q.shape) * hand,
        held_out=(readings.pose >= 10) & (readings.pose < 15),
    )  # fmt: skip
    parameters = identifiable_parameters(nominal, EFFECTS, observable=observable)
    metrology = Metrology(sigma=SIGMA)
    return evaluate_fit(
        nominal, fit_session(readings, parameters, metrology, observable=observable), diagnose=False
    )
