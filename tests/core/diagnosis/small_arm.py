"""A three-joint arm whose truth comes from the blind benchmark's mechanics, not from core.

Small, so that a whole diagnosis takes a second or less.
"""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np

from benchmarks.blind.arms import ArmKind, Row
from benchmarks.blind.measuring import Instrument, read_arm
from benchmarks.blind.mechanics import RealArm, Session, stand, turn
from benchmarks.blind.session import Plan, draw_session, play
from gapbridge.core.arm import JointLimits, arm_from_dh
from gapbridge.core.diagnosis.diagnosis import Diagnosis, diagnose
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

H = np.pi / 2
SIGMA = 2e-5  # m
FLOOR = 3e-5  # m, tracker and repeatability
KIND = ArmKind(
    "small",
    (
        Row(0.1, H, 0.4, 0.0, 9.0, (0.0, -0.1, 0.05)),
        Row(0.5, 0.0, 0.0, 0.0, 12.0, (-0.25, 0.0, 0.1)),
        Row(0.45, 0.3, 0.12, 0.0, 6.0, (-0.2, 0.0, 0.03)),
    ),
    (-2.6, -2.4, -2.3),
    (2.6, 2.4, 2.3),
    10.0,
    60.0,
    (1e-5, 1e-5, 2e-5),
    (4e-6, 3e-6, 6e-6),
    0.15,
)
PLAN = Plan(poses=60)
TOOL = np.array([0.05, -0.03, 0.15])
NOMINAL = RealArm(
    rows=KIND.rows, tool_position=TOOL, tool_rotation=np.eye(3), axial=np.zeros(3),
    radial=np.zeros(3), gravity=np.array([0.0, 0.0, -9.80665]),
)  # fmt: skip
LIMITS = JointLimits(
    np.array(KIND.low) - 0.1, np.array(KIND.high) + 0.1, np.full(3, np.inf), np.full(3, np.inf)
)
ELSEWHERE = {"rotation": turn(np.array([[0.3, -0.8, 1.2]]))[0], "position": np.array([2.0, -1, 0])}


def model_of(nominal: RealArm = NOMINAL) -> Model:
    """Return the model that a user would have of the arm."""
    rows = [
        {"a": r.a, "alpha": r.alpha, "d": r.d, "offset": r.offset, "mass": r.mass, "cog": r.cog}
        for r in nominal.rows
    ]
    tool = np.eye(4)
    tool[:3, 3] = nominal.tool_position
    arm = replace(arm_from_dh(rows, "small", LIMITS), payload=KIND.rated)
    return Model(arm, tool).with_compliance(nominal.axial, nominal.radial)


def session_of(seed: int = 0, plan: Plan = PLAN) -> Session:
    return draw_session(KIND, plan, np.random.default_rng(seed))


def readings(real: RealArm, session: Session, seed: int = 0, registered: bool = True):
    """Return what the tracker reads (N, 3), noise and repeatability in it."""
    shape = stand(NOMINAL, session)
    lever = np.cross(shape.axes[..., 2], shape.tcp - shape.origin)
    spread = float((lever**2).sum(axis=0).mean())
    frame = {"rotation": np.eye(3), "position": np.zeros(3)} if registered else ELSEWHERE
    instrument = Instrument(
        registered=registered, sigma=SIGMA, sigma_turn=None,
        joint_sigma=float(np.sqrt((FLOOR**2 - SIGMA**2) / spread)), **frame,
    )  # fmt: skip
    return read_arm(real, session, instrument, np.random.default_rng(seed + 1000))[0]


def log_of(session: Session, position, **more) -> Log:
    """Return the log of a session; ``more`` replaces columns, None takes one out."""
    columns = {
        "timestamp": session.time, "actual_q": session.q, "payload": session.payload_mass,
        "payload_cog": session.payload_cog, "actual_TCP_force": session.tcp_wrench,
        "joint_temperatures": session.temperature, "approach": session.approach,
        "measured_position": position,
    } | more  # fmt: skip
    kept = {k: np.asarray(v, dtype=float) for k, v in columns.items() if v is not None}
    return Log("small.csv", kept, 3)


def turned(joint: int, angle) -> RealArm:
    """Return the arm whose joint (from 1) is off by ``angle(session, q of the joint)``, rad."""

    def error(session: Session):
        out = np.zeros_like(session.q)
        out[:, joint - 1] = angle(session, session.q[:, joint - 1])
        return out

    return replace(NOMINAL, angle_errors=(error,))


def soft(joint: int, flexibility: float) -> RealArm:
    """Return the arm whose joint (from 1) gives way about its axis, rad/Nm."""
    axial = np.zeros(3)
    axial[joint - 1] = flexibility
    return replace(NOMINAL, axial=axial)


REAL = {
    "none": NOMINAL,
    "joint_offset": turned(2, lambda s, q: np.full(len(q), 8e-4)),
    "transmission_error": turned(3, lambda s, q: 6e-4 * np.sin(2 * q + 0.7)),
    "backlash": turned(2, lambda s, q: play(s, 1, 9e-4)),
    "axial_compliance": soft(2, 4e-6),
    "payload": replace(NOMINAL, axial=np.array(KIND.axial), more_payload=1.5),
    "tool_frame": replace(NOMINAL, tool_position=TOOL + np.array([4e-4, -3e-4, 5e-4])),
    "gravity_direction": replace(
        NOMINAL, axial=np.array(KIND.axial),
        gravity=turn(np.array([[0.05, -0.06, 0.0]]))[0] @ NOMINAL.gravity,
    ),
    "thermal_drift": replace(NOMINAL, expansion=2.4e-5),
    # in no catalogue: one joint that goes off by the square of another's angle
    "cross_coupling": replace(
        NOMINAL, angle_errors=(lambda s: np.outer(s.q[:, 1] ** 2, [0.0, 0.0, 2.5e-4]),)
    ),
}  # fmt: skip
COMPLIANT = replace(NOMINAL, axial=np.array(KIND.axial))


def nominal_of(effect: str) -> RealArm:
    """Return the arm as the user's model holds it: compliant where loads have to show."""
    return COMPLIANT if effect in ("payload", "gravity_direction") else NOMINAL


@functools.cache
def diagnosed(effect: str, seed: int = 0, registered: bool = True, **options) -> Diagnosis:
    """Return the diagnosis of an effect's log; made once in a test run."""
    session = session_of(seed)
    log = log_of(session, readings(REAL[effect], session, seed, registered))
    metrology = Metrology(registered=registered, sigma=SIGMA)
    return diagnose(model_of(nominal_of(effect)), log, metrology, **options)
