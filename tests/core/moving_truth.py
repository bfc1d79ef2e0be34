"""Moving arms as they would be: Pinocchio for forces, closed forms for motion. Shares nothing
with the model under test but the URDF text."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from gapbridge.core.arm import Arm
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.urdf import arm_from_urdf

TOOL = np.array([0.01, -0.02, 0.15])  # m, TCP in the flange, not turned
COG = np.array([0.02, 0.03, 0.08])  # m, payload in the flange


@dataclass(frozen=True)
class Plant:
    """The same random arm twice: for the model under test and for Pinocchio."""

    arm: Arm
    urdf: str

    def pinocchio(self, link: int | None = None, more: float = 0.0, payload: float = 0.0):
        """Return a Pinocchio model whose flange is a joint of its own that stays at zero.

        Link ``link`` (from 1) has its mass and inertia scaled by 1 + more.
        """
        model = pin.buildModelFromXML(self.urdf)
        model.gravity.linear = np.array([0, 0, -9.80665])
        if link is not None:
            old = model.inertias[link]
            model.inertias[link] = pin.Inertia(
                old.mass * (1 + more), old.lever, old.inertia * (1 + more)
            )
        model.inertias[model.njoints - 1] = pin.Inertia(payload, COG, np.zeros((3, 3)))
        return model

    def model(self, payload: float = 0.0) -> Model:
        tool = np.eye(4)
        tool[:3, 3] = TOOL
        return Model(self.arm, tool, payload, COG)

    def dynamics(self, q, qd, qdd, pull=None, payload=0.0, link=None, more=0.0):
        """Return motor torques (N, n) and what the load does to the flange sensor (N, 6)."""
        model = self.pinocchio(link, more)
        data = model.createData()
        n, hand = self.arm.n, model.njoints - 1
        mass = np.broadcast_to(payload, len(q))
        torque, wrench = np.empty((len(q), n)), np.empty((len(q), 6))
        for r in range(len(q)):
            model.inertias[hand] = pin.Inertia(float(mass[r]), COG, np.zeros((3, 3)))
            angles = np.append(q[r], 0)
            outside = [pin.Force.Zero() for _ in range(model.njoints)]
            if pull is not None:
                pin.forwardKinematics(model, data, angles)
                R = data.oMi[hand].rotation
                f, m = R.T @ pull[r, :3], R.T @ pull[r, 3:]
                outside[hand] = pin.Force(f, m + np.cross(TOOL, f))
            args = (angles, np.append(qd[r], 0), np.append(qdd[r], 0), outside)
            torque[r] = pin.rnea(model, data, *args)[:n]
            wrench[r] = -data.f[hand].vector
        return torque, wrench


def plant(folder: Path, n: int, seed: int) -> Plant:
    """Return a random arm of n joints whose flange hangs on a moving joint for Pinocchio only."""
    rng = np.random.default_rng(seed)
    links, joints = ['<link name="base"/>'], []
    for i in range(1, n + 1):
        mass = 8.0 * 0.75**i
        size = 0.15 + 0.05 * rng.random(3)
        x, y, z = mass * size**2 * np.array([1, 1, 0.5])
        cog = rng.uniform(-0.1, 0.1, 3) + np.array([0, 0, 0.1])
        links.append(
            f'<link name="l{i}"><inertial><origin xyz="{_text(cog)}" rpy="0.1 0.2 0.3"/>'
            f'<mass value="{mass:.17g}"/><inertia ixx="{x:.17g}" iyy="{y:.17g}" izz="{z:.17g}" '
            f'ixy="{0.1 * z:.17g}" ixz="0" iyz="{-0.05 * z:.17g}"/></inertial></link>'
        )
        place = rng.uniform(-0.08, 0.08, 3) + np.array([0, 0, 0.3])
        axis = ("0 0 1", "0 1 0")[(i + 1) % 2 if i > 1 else 0]
        joints.append(_joint(i, "revolute", f"l{i - 1}" if i > 1 else "base", f"l{i}", place, axis))
    links.append('<link name="flange"/>')
    head, tail = f'<robot name="r{seed}">', "</robot>"
    end = [0, 0, 0.1]
    fixed = _joint(n + 1, "fixed", f"l{n}", "flange", end, "0 0 1")
    path = folder / f"arm{n}_{seed}.urdf"
    path.write_text("\n".join([head, *links, *joints, fixed, tail]))
    loose = _joint(n + 1, "revolute", f"l{n}", "flange", end, "0 0 1")
    return Plant(arm_from_urdf(path), "\n".join([head, *links, *joints, loose, tail]))


def _text(vector) -> str:
    return " ".join(f"{v:.17g}" for v in vector)


def _joint(i, kind, parent, child, place, axis) -> str:
    return (
        f'<joint name="j{i}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{_text(place)}" rpy="0 0 {0.1 * i}"/><axis xyz="{axis}"/>'
        '<limit lower="-6.3" upper="6.3" velocity="3" effort="100"/></joint>'
    )


@dataclass(frozen=True)
class Course:
    """Sums of sines, known at any time."""

    amplitude: np.ndarray  # (n, m)
    frequency: np.ndarray  # (n, m) rad/s
    phase: np.ndarray  # (n, m)
    centre: np.ndarray  # (n,)

    def at(self, t, order=0):
        """Return the derivative of this order (N, n) at times (N,)."""
        angle = t[:, None, None] * self.frequency + self.phase + order * np.pi / 2
        waves = self.amplitude * self.frequency**order * np.sin(angle)
        return waves.sum(axis=2) + (self.centre if order == 0 else 0.0)

    def lagged(self, t, constant):
        """Return the steady response (N, n) of first-order lags with time constants (n,)."""
        c = np.asarray(constant)[:, None]
        gain = 1 / np.sqrt(1 + (self.frequency * c) ** 2)
        angle = t[:, None, None] * self.frequency + self.phase - np.arctan(self.frequency * c)
        return (self.amplitude * gain * np.sin(angle)).sum(axis=2) + self.centre


def course(n: int, seed: int) -> Course:
    """Return a lively course: 0.1 to 0.7 Hz, up to 1 rad/s."""
    rng = np.random.default_rng(seed)
    frequency = 2 * np.pi * rng.uniform(0.1, 0.7, (n, 4))
    return Course(
        rng.uniform(0.2, 0.5, (n, 4)) / frequency,
        frequency,
        rng.uniform(0, 2 * np.pi, (n, 4)),
        rng.uniform(-0.8, 0.8, n),
    )


def log_of(n: int, **columns) -> Log:
    """Return a log as reading a file would."""
    return Log("truth.csv", {k: np.asarray(v, dtype=float) for k, v in columns.items()}, n)


def poses(n: int, count: int, seed: int) -> np.ndarray:
    """Return poses at rest (N, n)."""
    return np.random.default_rng(seed).uniform(-2, 2, (count, n))


def fit(arm: Arm, observation, terms, rounds=8):
    """Fit terms as a selection engine does: numeric columns, Gauss-Newton on the exact predict.

    Returns the fitted terms and the standard deviations of all parameters.
    """
    scales = [
        np.array([p.scale for p in CATALOGUE[t.effect].parameters(arm, t.site)]) for t in terms
    ]
    w = observation.weight
    for _ in range(rounds):
        left = ((observation.measured - observation.predict(terms)) * w).ravel()
        columns = []
        for k, scale in enumerate(scales):
            for p in range(len(scale)):
                step = np.zeros(len(scale))
                step[p] = 1e-2 * scale[p]
                there = [_moved(terms, k, step), _moved(terms, k, -step)]
                up, down = (observation.predict(t) for t in there)
                columns.append((((up - down) / 2e-2) * w).ravel())
        A = np.column_stack(columns)
        active = np.linalg.norm(A, axis=0) > 1e-12
        step = np.zeros(A.shape[1])
        step[active] = np.linalg.lstsq(A[:, active], left, rcond=1e-10)[0]
        begin = 0
        for k, scale in enumerate(scales):
            terms = _moved(terms, k, step[begin : begin + len(scale)] * scale)
            begin += len(scale)
    left = ((observation.measured - observation.predict(terms)) * w).ravel()
    spread = np.full(A.shape[1], np.inf)
    covariance = np.linalg.pinv(A[:, active].T @ A[:, active]) * (left @ left) / len(left)
    spread[active] = np.sqrt(np.diag(covariance)) * np.concatenate(scales)[active]
    return terms, spread


def _moved(terms, k, step):
    moved = list(terms)
    moved[k] = terms[k].with_values(np.array(terms[k].values) + step)
    return moved
