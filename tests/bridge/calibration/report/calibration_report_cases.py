"""A calibration made by simulation, with its own small fit, for the tests of the report."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from functools import cache
from pathlib import Path

import numpy as np

from bridge.calibration.report import InstrumentFacts, SessionFacts
from core.arm import builtin_arm
from core.calibration.plan import Expectation, Payload, Plan, PlannedPose
from core.calibration.readings import Readings
from core.calibration.result import Calibration, Errors, Estimate
from core.effects import CATALOGUE, Site, Term
from core.loads import Loads
from core.model import Model
from core.registration import Registration, frame_columns, register_robustly
from core.rotation import rotation_matrix

LOADS = (Payload(1.0, (0.0, 0.0, 0.03), "gripper alone"), Payload(8.0, (0.02, 0.0, 0.09), "8 kg"))
SIGMA, REPEATABILITY = 1.5e-5, 2.0e-5
POSES, HELD_OUT, REPEATED, REPEATS = 40, 14, 6, 5
SITES = [("joint_offset", j) for j in (2, 3, 4, 5, 6)] + [
    ("axial_compliance", j) for j in (2, 3, 4)] + [("radial_compliance", 2)]  # fmt: skip
TRUE = (8e-4, -5e-4, 6e-4, -9e-4, 4e-4, 2.2e-5, 1.6e-5, 8e-6, 3e-6)
FRAME = Registration(rotation_matrix(np.array([0.1, -0.2, 0.7])), np.array([2.2, -1.1, 0.4]))


def session(**changes) -> SessionFacts:
    """Return the facts of a session."""
    given = {
        "cell": "Cell 7", "arm": "ur10e", "folder": Path("sessions/cell7"),
        "instrument": InstrumentFacts("laser tracker", serial="LT-4411",
                                      certificate="2026-03, no. 88120", sigma=SIGMA, error=1.5e-5,
                                      error_per_metre=6e-6, distance=2.5),
        "started": datetime(2026, 11, 21, 9, 12), "ended": datetime(2026, 11, 21, 11, 47),
        "readings": 78, "undone": 2, "serial": "2019-334-117", "operator": "M. Łukasik",
        "customer": "Beispiel & Söhne <Werk 2>", "place": "Hall 3", "temperature": (21.4, 23.0),
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
    tip = model.with_terms(_terms(TRUE)).predict(q[pose], loads).position
    tip = tip + rng.normal(0, np.hypot(SIGMA, REPEATABILITY), tip.shape)
    value = tip @ FRAME.rotation.T + FRAME.position
    count, zeros = len(pose), np.zeros(len(pose), dtype=np.int64)
    return Readings(
        "position", q[pose], value, np.full(count, SIGMA), loads, load, zeros, zeros,
        pose >= POSES, pose,
    )  # fmt: skip


def _fit(model: Model, readings: Readings):
    """Return values, covariance, frame: Gauss-Newton with the instrument's frame along."""
    fitted = readings[~readings.held_out]
    scale = np.array([CATALOGUE[e].parameters(model.arm, Site(j))[0].scale for e, j in SITES])
    values = np.zeros(len(SITES))

    def place(v):
        return model.with_terms(_terms(v)).predict(fitted.q, fitted.loads).position

    for _ in range(4):
        at = place(values)
        frame = register_robustly(fitted.value, at)
        J = np.stack([(place(values + s) - at) / 1e-3 for s in 1e-3 * np.diag(scale)], axis=2)
        A = np.concatenate([J, frame_columns(at)[:, :3]], axis=2).reshape(-1, len(scale) + 6)
        b = (frame.in_base(fitted.value) - at).ravel()
        step = np.linalg.lstsq(A, b, rcond=None)[0]
        values = values + scale * step[: len(scale)]
    left = b - A @ step
    noise = float(np.sqrt(left @ left / (len(left) - A.shape[1])))
    covariance = noise**2 * np.linalg.inv(A.T @ A)[: len(scale), : len(scale)]
    frame = frame.moved(step[len(scale) :])
    return values, covariance * np.outer(scale, scale), frame, noise, J / scale


@cache
def calibration(seed: int = 3) -> Calibration:
    """Return the calibration of a simulated session."""
    tool = np.eye(4)
    tool[:3, 3] = 0.08, 0.0, 0.15
    nominal = Model(builtin_arm("ur10e"), tool_in_flange=tool)
    readings = _readings(nominal, seed)
    values, covariance, frame, noise, _ = _fit(nominal, readings)
    model = nominal.with_terms(_terms(values))
    held, std = readings.held_out, np.sqrt(np.diag(covariance))

    def errors(m: Model, rows) -> Errors:
        measured = readings[rows]
        at = m.predict(measured.q, measured.loads).position
        fitted = readings[~held]
        base = m.predict(fitted.q, fitted.loads).position
        best = frame if m is model else register_robustly(fitted.value, base)
        return Errors(best.in_base(measured.value) - at, np.flatnonzero(rows))

    estimates = [
        Estimate(f"{e}_{j}", v, s, "rad" if e == "joint_offset" else "rad/Nm", 1.05 * s)
        for (e, j), v, s in zip(SITES, values, std, strict=True)
    ]
    estimates.append(Estimate("joint_offset_1", 0.0, float("inf"), "rad", None, shown=False))
    J = np.stack([
        (nominal.with_terms(_terms(values + d)).predict(readings.q[held], readings.loads[held])
         .position - model.predict(readings.q[held], readings.loads[held]).position) / d.sum()
        for d in np.diag(std)
    ], axis=2)  # fmt: skip
    tcp = np.sqrt(np.einsum("nip,pq,niq->n", J, covariance, J))
    return Calibration(
        model, nominal, readings, tuple(estimates), covariance,
        ("zero of joint 1 and the turn of the instrument's frame about the base's z axis",),
        errors(nominal, ~held), errors(model, ~held), errors(nominal, held), errors(model, held),
        np.array([11]), noise, REPEATABILITY, (frame,), tcp, None, True,
        "The calibrated model predicts poses that it never saw as well as arm and instrument "
        "repeat.",
    )  # fmt: skip


@cache
def plan(seed: int = 3) -> Plan:
    """Return the plan that such a session follows."""
    c = calibration(seed)
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
