"""A calibration made by simulation, for the tests of the report."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from functools import cache
from pathlib import Path

import numpy as np

from gapbridge.bridge.calibration.report import InstrumentFacts, SessionFacts
from gapbridge.core.arm import builtin_arm
from gapbridge.core.calibration.fit import evaluate_fit, fit_session
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.plan import Expectation, Payload, Plan, PlannedPose
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.result import Calibration
from gapbridge.core.effects import Site, Term
from gapbridge.core.estimation.registration import Registration
from gapbridge.core.loads import Loads
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix

LOADS = (Payload(1.0, (0.0, 0.0, 0.03), "gripper alone"), Payload(8.0, (0.02, 0.0, 0.09), "8 kg"))
SIGMA, REPEATABILITY, JOINT = 1.5e-5, 2.0e-5, 2.0e-5  # m, m, rad
POSES, HELD_OUT, REPEATED, REPEATS = 40, 14, 6, 5
EFFECTS = ("joint_offset", "axial_compliance", "radial_compliance_2")
SITES = [("joint_offset", j) for j in (2, 3, 4, 5, 6)] + [
    ("axial_compliance", j) for j in (2, 3, 4)] + [("radial_compliance", 2)]  # fmt: skip
TRUE = (8e-4, -5e-4, 6e-4, -9e-4, 4e-4, 2.2e-5, 1.6e-5, 8e-6, 3e-6)
FRAME = Registration(rotation_matrix(np.array([0.1, -0.2, 0.7])), np.array([2.2, -1.1, 0.4]))


def session(**changes) -> SessionFacts:
    """Return the facts of a session."""
    given = {
        "cell": "Cell 7", "arm": "ur10e", "folder": Path("sessions/cell7"),
        "instrument": InstrumentFacts("laser tracker", serial="LT-4411",
                                      certificate="2026-03, no. 88120", sigma=SIGMA,
                                      distance=2.5),
        "started": datetime(2026, 11, 21, 9, 12), "ended": datetime(2026, 11, 21, 11, 47),
        "readings": 132, "undone": 2, "serial": "2019-334-117", "operator": "M. Łukasik",
        "customer": "Beispiel & Söhne <Werk 2>",
        "remarks": ("Reading 31 was taken back: the reflector was not seated.",),
    }  # fmt: skip
    return SessionFacts(**(given | changes))


def _terms(values):
    return tuple(
        Term(effect, Site(joint), (float(v),))
        for (effect, joint), v in zip(SITES, values, strict=True)
    )


def _readings(model: Model, seed: int) -> Readings:
    """Return two loads at every pose, some poses several times, the last ones held out."""
    rng = np.random.default_rng(seed)
    q = rng.uniform([-2.6, -2.3, 0.4, -2.5, -2.2, -2.5], [2.6, -0.5, 2.4, 0.3, 2.2, 2.5],
                    (POSES + HELD_OUT, 6))  # fmt: skip
    visits = [(p, k) for k in (0, 1) for p in range(len(q)) for _ in range(
        REPEATS if p < REPEATED and k else 1)]  # fmt: skip
    pose, load = (np.array(column) for column in zip(*visits, strict=True))
    cog = np.array([LOADS[k].cog for k in load])
    loads = Loads(payload_mass=np.array([LOADS[k].mass for k in load]), payload_cog=cog)
    stands = q[pose] + rng.normal(0, JOINT, (len(pose), 6))  # where the arm came to rest
    tip = model.with_terms(_terms(TRUE)).predict(stands, loads).position
    tip = tip + rng.normal(0, SIGMA, tip.shape)
    tip[11] += 2e-3, -1e-3, 0.0
    value = tip @ FRAME.rotation.T + FRAME.position
    count, zeros = len(pose), np.zeros(len(pose), dtype=np.int64)
    return Readings(
        "position", q[pose], value, np.full(count, SIGMA), loads, load, zeros, zeros,
        pose >= POSES, pose,
    )  # fmt: skip


@cache
def calibration(diagnose: bool = False) -> Calibration:
    """Return the calibration of a simulated session, with an outlier in it."""
    tool = np.eye(4)
    tool[:3, 3] = 0.08, 0.0, 0.15
    nominal = Model(builtin_arm("ur10e"), tool_in_flange=tool)
    parameters = identifiable_parameters(nominal, EFFECTS, observable=make_observable("position"))
    expected = Expectation(
        parameters.names, parameters.units, 0.02 * parameters.scales, parameters.prior, 2.1e-5,
        4.4e-5,
    )  # fmt: skip
    metrology = Metrology(sigma=SIGMA, repeatability=REPEATABILITY)
    readings = _readings(nominal, 3)
    return evaluate_fit(
        nominal, fit_session(readings, parameters, metrology), expected=expected, diagnose=diagnose
    )


@cache
def plan() -> Plan:
    """Return the plan that such a session follows."""
    c = calibration()
    r = c.readings
    seen: dict[tuple[int, int], int] = {}
    poses = []
    for i in range(len(r)):
        key = (int(r.pose[i]), int(r.load[i]))
        seen[key] = seen.get(key, -1) + 1
        poses.append(PlannedPose(key[0], r.q[i], key[1], np.zeros(6), held_out=bool(r.held_out[i]),
                                 repeat=seen[key]))  # fmt: skip
    shown = [e for e in c.estimates if e.shown]
    expected = Expectation(
        tuple(e.name for e in shown), tuple(e.unit for e in shown),
        np.array([e.expected_std or 0.0 for e in shown]), np.full(len(shown), 1e-3), 2.1e-5, 4.4e-5,
    )  # fmt: skip
    bought = tuple((k, 2.1e-5 * (40 / k) ** 0.5) for k in (12, 16, 24, 32, 40, 60))
    return Plan(LOADS, tuple(poses), expected, bought, 640.0)


def without_repeats(c: Calibration) -> Calibration:
    """Return a calibration whose repeatability nobody measured."""
    return replace(c, repeatability=float("nan"))
