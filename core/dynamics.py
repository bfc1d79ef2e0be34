"""Rigid dynamics of many rows: joint torques and the wrench at the flange sensor.

Newton-Euler in base axes, per link: link i needs the force f = m (a - g) at its centre of gravity
and the moment I alpha + omega x I omega; joint j delivers the component about its axis. The
contributions are kept separate (``Contributions``), since effects scale them one by one. Signs: a
torque is that of the motor, positive about the joint's axis; a wrench of the surroundings on the
tool enters with -J^T F, as in UR's ``actual_current_as_torque`` and ``target_moment``. A sensor
wrench is that of the load on the sensor: m (g - a), plus the external wrench. The payload is a
point mass. Deflections are neglected in torques. Source: Featherstone, "Rigid Body Dynamics
Algorithms" (2008), ch. 5.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.effects import CATALOGUE, Term, acting, totals
from gapbridge.core.kernels import rigid
from gapbridge.core.kernels.reference import Chain
from gapbridge.core.model import Model
from gapbridge.core.motion import Contributions, Motion

MIN_MASS = 1e-6  # kg, of a link, to divide a first moment by
PAIRS = ((0, 1), (0, 2), (1, 2))  # of a link's axes
OWN_SHIFT = 0.15  # m that a link's own mass may lie elsewhere: what shifts its centre of gravity
# farther (a counterweight) adds no inertia beyond that, which would grow with the square


class Frames(NamedTuple):
    """Poses, velocities and accelerations of the frames of N rows, base axes."""

    origin: Array  # (N, n+1, 3) m: joints, then the flange
    rotation: Array  # (N, n+1, 3, 3): links, then the flange
    omega: Array  # (N, n, 3) rad/s of each link
    alpha: Array  # (N, n, 3) rad/s2
    acceleration: Array  # (N, n+1, 3) m/s2 of each origin

    def at(self, link: int, offset: Array) -> tuple[Array, Array]:
        """Return position and acceleration (N, 3) of a point ``offset`` (N, 3) from an origin.

        ``link`` counts from 0; n is the flange. ``offset`` is in base axes.
        """
        body = min(link, self.omega.shape[1] - 1)
        omega, alpha = self.omega[:, body], self.alpha[:, body]
        relative = np.cross(alpha, offset) + np.cross(omega, np.cross(omega, offset))
        return self.origin[:, link] + offset, self.acceleration[:, link] + relative


def frames_of(chain: Chain, q: Array, qd: Array, qdd: Array) -> Frames:
    """Return the frames of a rigid chain at angles, speeds, accelerations (N, n each)."""
    count, n = q.shape
    frames = Frames(
        np.empty((count, n + 1, 3)), np.empty((count, n + 1, 3, 3)), np.empty((count, n, 3)),
        np.empty((count, n, 3)), np.empty((count, n + 1, 3)),
    )  # fmt: skip
    rigid.frames_of_rows(chain, np.stack([q, qd, qdd]), frames)
    return frames


def contributions_of(model: Model, motion: Motion) -> Contributions:
    """Return the contributions of links, payload and external wrench along a motion.

    The model's effects on geometry and gravity are included (joint offsets, say); those on sensor
    and motors are applied later, by ``sense`` and ``drive``.
    """
    load_channels = {"wrench", "torque"}
    geometry = replace(
        model,
        terms=tuple(t for t in model.terms if not load_channels & {*CATALOGUE[t.effect].channels}),
    )
    chain, rows = geometry.chain(), geometry.rows(motion.q, motion.loads)
    frames = frames_of(chain, rows.q, motion.qd, motion.qdd)
    n, count = model.arm.n, len(motion)

    def link_at(i: int, cog: Array) -> Array:
        body = np.vstack([cog, [chain.mass[i], 0.0, 0.0], model.arm.inertia[i]])
        return _link_torque(frames, i, body, chain.gravity)

    link_torque = np.stack([link_at(i, chain.cog[i]) for i in range(n)], axis=1)
    hand = frames.rotation[:, n]
    sensor = _with_deflection(model, motion, frames)
    tcp_at_sensor = sensor.origin[:, n] + sensor.rotation[:, n] @ chain.tool_position
    tcp = frames.origin[:, n] + hand @ chain.tool_position
    pull, couple = rows.wrench[:, :3], rows.wrench[:, 3:]
    zeros = np.zeros((count, 3))

    def payload_from(shift: Array) -> tuple[Array, Array]:
        cog = rows.payload_cog + shift
        point, acceleration = frames.at(n, _rotated(hand, cog))
        force = acceleration - chain.gravity
        point_at_sensor, _ = sensor.at(n, _rotated(sensor.rotation[:, n], cog))
        return (
            _about_axes(frames, n, point, force, zeros),
            _at_flange(sensor, point_at_sensor, -force, zeros),
        )

    @functools.cache
    def shift_torque(i: int) -> Array:
        """Return the torques (9, N * n) per m along each axis of link i, and per product of two."""

        def more(shift: Array) -> Array:
            return (link_at(i, chain.cog[i] + shift) - link_torque[:, i]).ravel()

        axes = np.eye(3)
        ahead, behind = [more(axis) for axis in axes], [more(-axis) for axis in axes]
        linear = [(f - b) / 2 for f, b in zip(ahead, behind, strict=True)]
        square = [(f + b) / 2 for f, b in zip(ahead, behind, strict=True)]
        mixed = [more(axes[j] + axes[k]) - ahead[j] - ahead[k] for j, k in PAIRS]
        return np.stack([*linear, *square, *mixed])

    def link_from(i: int, moment: Array) -> Array:
        shift = moment / max(float(chain.mass[i]), MIN_MASS)
        near = shift * min(1.0, OWN_SHIFT / max(float(np.linalg.norm(shift)), OWN_SHIFT))
        products = [*(near**2), *(near[j] * near[k] for j, k in PAIRS)]
        return np.asarray((np.array([*shift, *products]) @ shift_torque(i)).reshape(count, n))

    payload_torque, payload_wrench = payload_from(np.zeros(3))
    return Contributions(
        link_torque=link_torque,
        arm_torque=link_torque.sum(axis=1),
        payload_torque=payload_torque,
        external_torque=-_about_axes(frames, n, tcp, pull, couple),
        payload_wrench=payload_wrench,
        external_wrench=_at_flange(sensor, tcp_at_sensor, pull, couple),
        payload_mass=rows.payload_mass,
        carried_mass=rows.payload_mass,
        payload_from=payload_from,
        link_from=link_from,
    )


def _link_torque(frames: Frames, i: int, body: Array, gravity: Array) -> Array:
    """Return the torques (N, n) of link i: ``body`` has centre of gravity, mass and inertia."""
    count, n = frames.omega.shape[:2]
    point, force, moment = (np.empty((count, 3)) for _ in range(3))
    rigid.taken_by_link(i, body, gravity, frames, point, force, moment)
    torque = np.zeros((count, n))
    torque[:, : i + 1] = _about_axes(frames, i + 1, point, force, moment)
    return torque


def _with_deflection(model: Model, motion: Motion, frames: Frames) -> Frames:
    """Return the frames with the flange's rotation of the deflected arm, for the sensor."""
    chain = model.chain()
    if not (chain.compliance.any() or chain.flexibility.any() or chain.base_compliance.any()):
        return frames
    deflected = model.predict(motion.q, motion.loads).rotation @ chain.tool_rotation.T
    rotation = frames.rotation.copy()
    rotation[:, -1] = deflected
    return frames._replace(rotation=rotation)


def _rotated(matrix: Array, vector: Array) -> Array:
    return np.asarray(np.einsum("rij,rj->ri", matrix, vector))


def _about_axes(frames: Frames, joints: int, point: Array, force: Array, moment: Array) -> Array:
    """Return the torques (N, joints), Nm, that balance ``force`` at ``point`` and ``moment``."""
    torque = np.empty((len(point), joints))
    force, moment = np.ascontiguousarray(force), np.ascontiguousarray(moment)  # as compiled for
    rigid.about_axes(frames, point, force, moment, torque)
    return torque


def _at_flange(frames: Frames, point: Array, force: Array, moment: Array) -> Array:
    """Return a force at a point and a moment as wrench (N, 6) in flange axes, about its origin."""
    hand = np.swapaxes(frames.rotation[:, -1], 1, 2)
    total = moment + np.cross(point - frames.origin[:, -1], force)
    return np.concatenate([_rotated(hand, force), _rotated(hand, total)], axis=1)


def with_holding_torque(model: Model, motion: Motion) -> Motion:
    """Return the motion with the holding torques of its poses at rest."""
    return replace(motion, held=model.holding_torque(motion.q, motion.loads))


def with_pieces(model: Model, motion: Motion) -> Motion:
    """Return the motion with the model's contributions, which effects and predictions need."""
    return replace(motion, pieces=contributions_of(model, motion))


def predict_torque(model: Model, motion: Motion, terms: Sequence[Term] = ()) -> Array:
    """Return the joint torques (N, n), Nm, that would be measured, with further ``terms``."""
    terms_used = acting((*model.terms, *terms), "torque")
    motion, pieces = _with_payload(model, motion, terms_used)
    torque: Array = pieces.arm_torque + pieces.external_torque
    torque = torque + pieces.payload_mass[:, None] * pieces.payload_torque
    for term in terms_used:
        effect = CATALOGUE[term.effect]
        if motion.load is None and not effect.loads_joints:
            motion = replace(motion, load=torque)
        torque = effect.drive(term, model.arm, torque, motion)
    return torque


def predict_wrench(model: Model, motion: Motion, terms: Sequence[Term] = ()) -> Array:
    """Return the wrenches (N, 6), N and Nm, that the flange sensor would read, with ``terms``.

    Flange axes, about the flange origin, payload included (docs/conventions.md, Loads).
    """
    terms_used = acting((*model.terms, *terms), "wrench")
    motion, pieces = _with_payload(model, motion, terms_used)
    wrench = pieces.payload_mass[:, None] * pieces.payload_wrench + pieces.external_wrench
    for term in terms_used:
        wrench = CATALOGUE[term.effect].sense(term, model.arm, wrench, motion)
    return wrench


def predict_tracking(model: Model, motion: Motion, terms: Sequence[Term] = ()) -> Array:
    """Return the predicted encoder angles (N, n), rad, for the motion's commands."""
    if motion.target_q is None:
        raise ValueError("the motion has no target_q")
    q = motion.target_q
    if motion.held is None:
        motion = with_holding_torque(model, motion)
    # one lag of the sum: a lag made shorter is not undone by a negative one behind it
    for term in acting(totals((*model.terms, *terms)), "tracking"):
        q = CATALOGUE[term.effect].track(term, model.arm, q, motion)
    return q


def _with_payload(
    model: Model, motion: Motion, terms: Sequence[Term]
) -> tuple[Motion, Contributions]:
    """Return the motion with the terms' payload mass added to the contributions."""
    pieces = contributions_of(model, motion) if motion.pieces is None else motion.pieces
    more = sum(t.values[0] for t in terms if CATALOGUE[t.effect].adds_mass)
    pieces = replace(pieces, carried_mass=pieces.payload_mass + more)
    return replace(motion, pieces=pieces, load=None), pieces
