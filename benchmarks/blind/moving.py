"""Exciting motions, and the torques they take: Fourier series, rigid bodies by Pinocchio."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.random import Generator

from benchmarks.blind.arms import ArmKind
from benchmarks.blind.mechanics import Array, Row, turn

if TYPE_CHECKING:
    import pinocchio as pin


@dataclass(frozen=True)
class Motion:
    """A sum of sines per joint: q(t) = centre + sum of amplitude sin(rate t + phase)."""

    centre: Array  # (n,)
    amplitude: Array  # (n, h)
    rate: Array  # (n, h) rad/s
    phase: Array  # (n, h)

    def at(self, time: Array, derivative: int = 0) -> Array:
        """Return q (N, n) at times (N,) or (N, n), or its derivative."""
        t = time[:, None, None] if time.ndim == 1 else time[:, :, None]
        angle = self.rate * t + self.phase + derivative * np.pi / 2
        wave = (self.amplitude * self.rate**derivative * np.sin(angle)).sum(axis=2)
        return np.asarray(wave + (self.centre if derivative == 0 else 0.0))

    def lagged(self, time: Array, delay: Array, lag: Array) -> Array:
        """Return q (N, n) behind a pure delay and a first-order lag per joint (s), settled."""
        slow = self.rate * lag[:, None]
        angle = self.rate * (time[:, None, None] - delay[:, None]) + self.phase - np.arctan(slow)
        return np.asarray(
            (self.amplitude / np.hypot(1.0, slow) * np.sin(angle)).sum(axis=2) + self.centre
        )


def draw_motion(kind: ArmKind, rng: Generator, swift: float = 1.0, terms: int = 5) -> Motion:
    """Return an exciting motion inside the arm's range, speeds up to about 1.5 rad/s."""
    low, high = np.array(kind.low), np.array(kind.high)
    middle, half = (low + high) / 2, (high - low) / 2
    heavy = 0.5 if kind.rated > 100 else 1.0
    rate = 2 * np.pi * swift * heavy * rng.uniform(0.05, 0.9, (kind.n, terms))
    amplitude = rng.uniform(0.3, 1.0, (kind.n, terms)) / rate
    reach = amplitude.sum(axis=1)
    speed = (amplitude * rate).sum(axis=1)
    scale = np.minimum(0.75 * half / reach, 1.5 * heavy / speed)
    centre = middle + rng.uniform(-0.2, 0.2, kind.n) * half
    phase = rng.uniform(-np.pi, np.pi, (kind.n, terms))
    return Motion(centre, amplitude * scale[:, None], rate, phase)


def torque_shares(
    rows: tuple[Row, ...], gravity: Array, payload_cog: Array, q: Array, qd: Array, qdd: Array
) -> tuple[Array, Array]:  # fmt: skip
    """Return torques (n, N, n) that each link takes, and (N, n) of 1 kg at the payload's place.

    Rigid point masses at their centres of gravity, exact inverse dynamics.
    """
    import pinocchio as pin  # of the test extra: only the torque channel needs it

    model, masses = pinocchio_arm(rows, gravity)
    data = model.createData()
    n, count = len(rows), len(q)
    last = rows[-1]
    flange = pin.SE3(turn(np.array([[last.alpha, 0, 0]]))[0], np.array([last.a, 0, last.d]))
    unit = pin.Inertia(1.0, flange.act(np.asarray(payload_cog)), np.zeros((3, 3)))
    kept = np.array([inertia.toDynamicParameters() for inertia in masses])
    one = unit.toDynamicParameters()
    links, carried = np.empty((n, count, n)), np.empty((count, n))
    for t in range(count):
        regressor = pin.computeJointTorqueRegressor(model, data, q[t], qd[t], qdd[t])
        blocks = regressor.reshape(n, n, 10)
        links[:, t, :] = np.einsum("jlk,lk->lj", blocks, kept)
        carried[t] = blocks[:, n - 1, :] @ one
    return links, carried


@dataclass(frozen=True)
class Shifts:
    """What centres of gravity that are elsewhere take of the joints: exact, inertia moves along."""

    regressor: Array  # (N, n, n, 10): torque of joint j per dynamic parameter of link l
    masses: Array  # (n,) kg, of the links
    centres: Array  # (n, 3) m, in the row's frame
    places: list[pin.SE3]  # of the row's frame in the joint's
    payload_cog: Array  # (3,) m, in the row's frame of the flange

    def of_link(self, link: int, moment: Array) -> Array:
        """Return the torques (N, n) that a first moment (3,) kg m of a link (from 0) takes more."""
        mass = max(float(self.masses[link]), 1e-9)
        return self._moved(link, mass, self.centres[link], moment / mass)

    def of_payload(self, mass: Array, shift: Array) -> Array:
        """Return the torques (N, n) of a payload of ``mass`` (N,) kg from ``shift`` (3,) m."""
        one = self._moved(len(self.masses) - 1, 1.0, self.payload_cog, shift)
        return mass[:, None] * one

    def _moved(self, link: int, mass: float, centre: Array, shift: Array) -> Array:
        import pinocchio as pin

        ends = [
            pin.Inertia(mass, self.places[link].act(at), np.zeros((3, 3))).toDynamicParameters()
            for at in (centre + shift, np.asarray(centre, dtype=float))
        ]
        return np.asarray(self.regressor[:, :, link] @ (ends[0] - ends[1]))


def shifts_of(
    rows: tuple[Row, ...], gravity: Array, payload_cog: Array, q: Array, qd: Array, qdd: Array
) -> Shifts:  # fmt: skip
    """Return what shifted centres of gravity do along a motion."""
    import pinocchio as pin

    model, _ = pinocchio_arm(rows, gravity)
    data = model.createData()
    n, count = len(rows), len(q)
    places = [pin.SE3(turn(np.array([[r.alpha, 0, 0]]))[0], np.array([r.a, 0, r.d])) for r in rows]
    regressor = np.empty((count, n, n, 10))
    for t in range(count):
        found = pin.computeJointTorqueRegressor(model, data, q[t], qd[t], qdd[t])
        regressor[t] = found.reshape(n, n, 10)
    masses, centres = np.array([r.mass for r in rows]), np.array([r.cog for r in rows])
    return Shifts(regressor, masses, centres, places, payload_cog)


def pinocchio_arm(rows: tuple[Row, ...], gravity: Array) -> tuple[pin.Model, list[pin.Inertia]]:
    """Return the arm as a Pinocchio model, and the inertia of each link in its joint's frame."""
    import pinocchio as pin

    model = pin.Model()
    model.gravity.linear = np.asarray(gravity, dtype=float)
    parent, place = 0, pin.SE3.Identity()
    masses = []
    for i, row in enumerate(rows):
        zero = pin.SE3(turn(np.array([[0, 0, row.offset]]))[0], np.zeros(3))
        parent = model.addJoint(parent, pin.JointModelRZ(), place * zero, f"joint_{i + 1}")
        step = pin.SE3(turn(np.array([[row.alpha, 0, 0]]))[0], np.array([row.a, 0, row.d]))
        inertia = pin.Inertia(row.mass, step.act(np.array(row.cog)), np.zeros((3, 3)))
        model.appendBodyToJoint(parent, inertia, pin.SE3.Identity())
        masses.append(inertia)
        place = step
    return model, masses
