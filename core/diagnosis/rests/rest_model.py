"""Readings at rest predicted by the rigid arm's model, and how a moved zero changes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.dynamics import predict_torque, predict_wrench, with_pieces
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion
from gapbridge.core.rotation import rotation_matrix

STEP = 1e-4  # rad, kg, kg m: of finite differences


@dataclass
class Place:
    """A pose to which the program returns."""

    q: Array  # (n,) rad
    mass: float  # kg, declared
    cog: Array  # (3,) m, declared
    side: bytes  # direction of approach of each joint
    predicted: Array  # (m,) readings of the rigid arm
    slip: Array  # (m, n) change of the readings per rad of each joint's zero
    free: Array  # (m, f) change of the readings per step of sensor zeros and payload


class RestModel:
    """Readings (m = 6 + n,) of a rigid arm at rest: flange wrench, N and Nm, then motor torques.

    ``mean`` is the mean of rows in a rest: joints (n,), flange wrench (6,), TCP wrench (6,), motor
    torques (n,), declared payload, kg, and its centre (3,), m.
    """

    def __init__(self, model: Model) -> None:
        self._model, self._n = model, model.arm.n

    def payload(self, mean: Array) -> tuple[float, Array]:
        """Return mass, kg, and centre (3,), m, declared by the controller, else by the cell."""
        declared = mean[2 * self._n + 12 :]
        if np.isfinite(declared).all():
            return float(declared[0]), declared[1:]
        return self._model.payload_mass, np.asarray(self._model.payload_cog)

    def readings(self, mean: Array, place: Place) -> Array:
        """Return measured minus predicted readings (6 + n,): flange wrench, motor torques."""
        n = self._n
        wrench, at_tcp = mean[n : n + 6], mean[n + 6 : n + 12]
        predicted = place.predicted + place.slip @ (mean[:n] - place.q)
        if np.isfinite(wrench).all():
            at_flange = wrench - predicted[:6]
        else:  # the controller's TCP wrench, without the declared payload
            at_flange = self._at_flange(mean[:n], at_tcp)
        return np.concatenate([at_flange, mean[n + 12 : 2 * n + 12] - predicted[6:]])

    def _at_flange(self, q: Array, at_tcp: Array) -> Array:
        """Return a wrench (6,) at the TCP, base axes, as one at the flange in its own axes."""
        tool = self._model.tool_in_flange
        flange_in_base = rotation_matrix(self._model.rigid_pose(q[None]).rotation_vector)[0]
        flange_in_base = flange_in_base @ tool[:3, :3].T
        force, torque = flange_in_base.T @ at_tcp[:3], flange_in_base.T @ at_tcp[3:]
        return np.concatenate([force, torque + np.cross(tool[:3, 3], force)])

    def place(self, q: Array, mass: float, cog: Array, side: bytes) -> Place:
        """Return a place with what the model predicts there."""
        return Place(q, mass, cog, side, *self._columns(q, mass, cog))

    def _columns(self, q: Array, mass: float, cog: Array) -> tuple[Array, Array, Array]:
        """Return readings (m,), their changes by joint zeros (m, n) and by other steps (m, f)."""
        n = self._n
        steps = STEP * np.vstack([np.eye(n), -np.eye(n), np.zeros(n)])
        turned = self._predicted(q + steps, mass, cog)
        slip, here = (turned[:n] - turned[n:-1]).T / (2.0 * STEP), turned[-1]
        moment = mass * cog
        payload = [
            (self._predicted(q[None], mass + STEP, (moment + m) / (mass + STEP))[0] - here) / STEP
            for m in STEP * np.vstack([np.zeros(3), np.eye(3)])
        ]
        payload[1:] = [column - payload[0] for column in payload[1:]]  # the moment's own
        return here, slip, np.column_stack([np.eye(6 + n), *payload])

    def _predicted(self, q: Array, mass: float, cog: Array) -> Array:
        """Return the rigid arm's readings (N, 6 + n) at rest."""
        loads = Loads(np.full(len(q), mass), np.tile(cog, (len(q), 1)))
        motion = with_pieces(self._model, Motion.at_rest(q, loads))
        wrench, torque = predict_wrench(self._model, motion), predict_torque(self._model, motion)
        return np.hstack([wrench, torque])
