"""Small diagnoses for the tests of the report, made once each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis.diagnosis import Diagnosis, diagnose
from gapbridge.core.effects import Site, Term
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

CASES = ("no gap", "explained", "unexplained", "partly explained", "rotations and forces", "slip")
METROLOGY = Metrology(registered=False, sigma=2e-5, repeatability=2e-5)


@dataclass(frozen=True)
class Case:
    diagnosis: Diagnosis
    log: Log
    model: Model


@cache
def diagnosed(name: str) -> Case:
    """Return the diagnosis of one of CASES."""
    if name == "no gap":
        return _case((), rows=24)
    if name == "explained":
        return _case((Term("axial_compliance", Site(2), (2e-5,)),), rows=60)
    if name == "slip":
        return _case((Term("joint_slip", Site(3), (5e-3, 730.0)),), rows=60)
    if name == "unexplained":
        return _case((Term("axial_compliance", Site(2), (2e-5,)),), 60, withhold=COMPLIANT)
    if name == "partly explained":
        return _with_structure(diagnosed("explained"))
    return _case((Term("joint_offset", Site(3), (1e-3,)),), rows=50, rotations=True, bias=3.0)


def _with_structure(case: Case) -> Case:
    """Return the case as it would be with residual structure: a real one takes 300 poses."""
    channel = replace(
        case.diagnosis.channels[0], verdict="partly_explained", structured=True,
        unexplained_rms=6e-5, p_value=1e-3, depends_on=(("timestamp", 0.4), ("actual_q_2", 0.2)),
    )  # fmt: skip
    diagnosis = replace(case.diagnosis, verdict="partly_explained", channels=(channel,))
    return Case(diagnosis, case.log, case.model)


COMPLIANT = ("axial_compliance", "stiffness_nonlinearity", "link_flexibility", "base_compliance",
             "payload", "payload_cog", "radial_compliance", "gravity_direction",
             "joint_offset", "link_geometry", "tool_frame")  # fmt: skip


def _case(
    terms: tuple[Term, ...], rows: int, withhold: tuple[str, ...] = (), rotations: bool = False,
    bias: float = 0.0,
) -> Case:  # fmt: skip
    model = Model(builtin_arm("ur10e"), payload_mass=4.0, payload_cog=np.array([0, 0, 0.05]))
    rng = np.random.default_rng(7)
    q = rng.uniform(-2.0, 2.0, (rows, 6))
    payload = np.repeat([2.0, 8.0], (rows + 1) // 2)[:rows]
    columns = {
        "timestamp": 20.0 * np.arange(rows), "actual_q": q, "payload": payload,
        "payload_cog": np.tile([0.0, 0.0, 0.05], (rows, 1)),
    }  # fmt: skip
    given = Log("some/log.csv", columns, 6)
    real = model.with_terms(terms).predict(q, given.loads())
    columns["measured_position"] = real.position + rng.normal(0, 2.8e-5, (rows, 3))
    if rotations:
        columns["measured_rotation"] = real.rotation_vector + rng.normal(0, 1e-4, (rows, 3))
    if bias:
        turn = np.swapaxes(real.rotation, 1, 2)
        weight = (turn @ np.array([0, 0, -9.80665])) * payload[:, None]
        moment = np.cross(np.tile([0.0, 0.0, 0.05], (rows, 1)), weight)
        wrench = np.hstack([weight, moment]) + rng.normal(0, 0.05, (rows, 6))
        wrench[:, 0] += bias
        columns["ft_raw_wrench"] = wrench
    log = Log("some/log.csv", columns, 6)
    return Case(diagnose(model, log, METROLOGY, withhold=withhold), log, model)
