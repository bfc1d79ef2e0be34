"""Short sessions made by simulation, for the tests of their reports."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from calibration_report_cases import JOINT, SIGMA, calibration

from gapbridge.core.arm import builtin_arm
from gapbridge.core.calibration.accuracy_baseline import baseline_document
from gapbridge.core.calibration.payload_session import PayloadCalibration, calibrate_payload
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.tool_session import ToolCalibration, calibrate_tool
from gapbridge.core.calibration.verify import Verification, verify
from gapbridge.core.effects import Site, Term
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model


@cache
def verification(moved: bool) -> tuple[Verification, Readings]:
    """Return the verification of a session's calibration, and what was read.

    ``moved``: the zero of joint 3 has changed by 0.5 mrad since.
    """
    c = calibration()
    rng = np.random.default_rng(8)
    rows = np.flatnonzero(c.readings.held_out)[:10]
    taken = c.readings[rows]
    real = c.model.with_terms((Term("joint_offset", Site(3), (5e-4 if moved else 0.0,)),))
    stands = taken.q + rng.normal(0, JOINT, taken.q.shape)
    tip = real.predict(stands, taken.loads).position + rng.normal(0, SIGMA, (len(rows), 3))
    frame = c.stations[0]
    readings = replace(taken, value=tip @ frame.rotation.T + frame.position)
    metrology = Metrology(sigma=SIGMA)
    baseline = baseline_document(c, sigma=SIGMA)
    return verify(c.model, readings, baseline, metrology), readings


@cache
def payload() -> tuple[PayloadCalibration, Model]:
    """Return what a session with the flange sensor found, and the model that the cell had."""
    model = Model(builtin_arm("ur10e"), payload_mass=3.5, payload_cog=np.array([0, 0, 0.06]))
    rng = np.random.default_rng(4)
    q = rng.uniform(-2.5, 2.5, (9, 6))
    turn = np.swapaxes(model.predict(q).rotation, 1, 2)
    force = 4.2 * (turn @ np.array([0, 0, -9.80665]))
    moment = np.cross(np.array([0.004, -0.012, 0.071]), force)
    noise = rng.normal(size=(9, 6)) * np.repeat([0.15, 0.008], 3)
    bias = np.array([2.1, -0.8, 4.4, 0.11, 0.02, -0.05])
    wrench = np.hstack([force, moment]) + bias + noise
    wrench[5, 0] += 12.0  # somebody leant on it
    return calibrate_payload(model, q, wrench), model


@cache
def tool() -> tuple[ToolCalibration, Model]:
    """Return what a session for the tool found, and the model that the cell had."""
    had = np.eye(4)
    had[:3, 3] = 0.0, 0.0, 0.15
    model = Model(builtin_arm("ur10e"), tool_in_flange=had)
    real = replace(model, tool_in_flange=had.copy())
    real.tool_in_flange[:3, 3] = 0.0021, -0.0034, 0.1524
    rng = np.random.default_rng(6)
    start = np.array([0.3, -1.3, 1.9, -2.2, -1.57, 0.2])
    q = start + np.column_stack([np.zeros((8, 3)), rng.uniform(-0.6, 0.6, (8, 3))])
    point = real.predict(start[None]).position[0]
    for _ in range(20):
        jacobian = real.linear_form(q).jacobian[:, :3]
        gap = point - real.predict(q).position
        q = q + np.einsum("nij,nj->ni", np.linalg.pinv(jacobian), gap)
    jacobian = real.linear_form(q).jacobian[:, :3]
    hand = rng.normal(0, 1e-4, (8, 3))
    q = q + np.einsum("nij,nj->ni", np.linalg.pinv(jacobian), hand)
    return calibrate_tool(model, q), model
