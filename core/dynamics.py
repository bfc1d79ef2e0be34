"""Rigid dynamics of many rows: joint torques and the wrench at the flange sensor.

Newton-Euler in base axes, one part of the arm at a time: what part i takes to be moved and held is
f = m (a - g) at its centre of gravity and the moment I alpha + omega x I omega; the motor of joint
j delivers the part of its moment about axis j. Parts are kept apart (``Pieces``) because effects
scale them one by one. Signs: a torque is what the motor must deliver, positive about the joint's
axis, so the weight it holds up counts positive against gravity, and a pull of the surroundings on
the tool enters with -J^T F; this is the sign of UR's ``actual_current_as_torque`` and
``target_moment``. A wrench is what the load does to the sensor: m (g - a), plus the pull. The
payload is a point mass (a log declares no inertia for it). Bending is left out: it changes torques
and wrenches by its own small angle. Source: Featherstone, "Rigid Body Dynamics Algorithms" (2008),
ch. 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.effects import CATALOGUE, Term, acting
from gapbridge.core.kernels import rigid
from gapbridge.core.kernels.reference import Chain
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion, Pieces

LIGHTEST = 1e-6  # kg, of a link whose centre of gravity is anywhere


class Frames(NamedTuple):
    """Where the frames of N rows are and how they move, base axes."""

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
        turning = np.cross(alpha, offset) + np.cross(omega, np.cross(omega, offset))
        return self.origin[:, link] + offset, self.acceleration[:, link] + turning


def frames_of(chain: Chain, q: Array, qd: Array, qdd: Array) -> Frames:
    """Return the frames of a rigid chain at angles, speeds, accelerations (N, n each)."""
    count, n = q.shape
    found = Frames(
        np.empty((count, n + 1, 3)), np.empty((count, n + 1, 3, 3)), np.empty((count, n, 3)),
        np.empty((count, n, 3)), np.empty((count, n + 1, 3)),
    )  # fmt: skip
    rigid.frames_of_rows(chain, np.stack([q, qd, qdd]), found)
    return found


def pieces_of(model: Model, motion: Motion) -> Pieces:
    """Return what each part of the model's rigid arm contributes along a motion.

    The model's own effects count where they move the geometry or the gravity (joint offsets, say);
    what loads the sensor or the motors does not count here, it enters by ``sense`` and ``drive``.
    """
    own = {"wrench", "torque"}
    geometry = replace(
        model, terms=tuple(t for t in model.terms if not own & {*CATALOGUE[t.effect].channels})
    )
    chain, rows = geometry.chain(), geometry.rows(motion.q, motion.loads)
    frames = frames_of(chain, rows.q, motion.qd, motion.qdd)
    n, count = model.arm.n, len(motion)

    def link_at(i: int, cog: Array) -> Array:
        body = np.vstack([cog, [chain.mass[i], 0.0, 0.0], model.arm.inertia[i]])
        return _link_torque(frames, i, body, chain.gravity)

    link_torque = np.stack([link_at(i, chain.cog[i]) for i in range(n)], axis=1)
    hand = frames.rotation[:, n]
    sensor = _bent_flange(model, motion, frames)
    tcp_in_hand = sensor.origin[:, n] + sensor.rotation[:, n] @ chain.tool_position
    tcp = frames.origin[:, n] + hand @ chain.tool_position
    pull, couple = rows.wrench[:, :3], rows.wrench[:, 3:]
    nothing = np.zeros((count, 3))

    def payload_from(shift: Array) -> tuple[Array, Array]:
        cog = rows.payload_cog + shift
        place, acceleration = frames.at(n, _times(hand, cog))
        force = acceleration - chain.gravity
        in_hand, _ = sensor.at(n, _times(sensor.rotation[:, n], cog))
        return (
            _about_axes(frames, n, place, force, nothing),
            _at_flange(sensor, in_hand, -force, nothing),
        )

    def link_from(i: int, moment: Array) -> Array:
        shift = moment / max(float(chain.mass[i]), LIGHTEST)
        return link_at(i, chain.cog[i] + shift) - link_torque[:, i]

    payload_torque, payload_wrench = payload_from(np.zeros(3))
    return Pieces(
        link_torque=link_torque,
        arm_torque=link_torque.sum(axis=1),
        payload_torque=payload_torque,
        external_torque=-_about_axes(frames, n, tcp, pull, couple),
        payload_wrench=payload_wrench,
        external_wrench=_at_flange(sensor, tcp_in_hand, pull, couple),
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


def _bent_flange(model: Model, motion: Motion, frames: Frames) -> Frames:
    """Return the frames with the flange turned as the arm bends: a sensor there sees it."""
    chain = model.chain()
    if not (chain.compliance.any() or chain.flexibility.any() or chain.base_compliance.any()):
        return frames
    deflected = model.predict(motion.q, motion.loads).rotation @ chain.tool_rotation.T
    rotation = frames.rotation.copy()
    rotation[:, -1] = deflected
    return frames._replace(rotation=rotation)


def _times(matrix: Array, vector: Array) -> Array:
    return np.asarray(np.einsum("rij,rj->ri", matrix, vector))


def _about_axes(frames: Frames, joints: int, point: Array, force: Array, moment: Array) -> Array:
    """Return the torques (N, joints) that hold ``force`` at ``point`` and ``moment``."""
    torque = np.empty((len(point), joints))
    force, moment = np.ascontiguousarray(force), np.ascontiguousarray(moment)  # as compiled for
    rigid.about_axes(frames, point, force, moment, torque)
    return torque


def _at_flange(frames: Frames, point: Array, force: Array, moment: Array) -> Array:
    """Return a force at a point and a moment as wrench (N, 6) in flange axes, about its origin."""
    hand = np.swapaxes(frames.rotation[:, -1], 1, 2)
    whole = moment + np.cross(point - frames.origin[:, -1], force)
    return np.concatenate([_times(hand, force), _times(hand, whole)], axis=1)


def with_held(model: Model, motion: Motion) -> Motion:
    """Return the motion with the torques that the joints hold in it at rest."""
    return replace(motion, held=model.held_torque(motion.q, motion.loads))


def with_pieces(model: Model, motion: Motion) -> Motion:
    """Return the motion with the model's contributions, which effects and predictions need."""
    return replace(motion, pieces=pieces_of(model, motion))


def predict_torque(model: Model, motion: Motion, terms: Sequence[Term] = ()) -> Array:
    """Return the joint torques (N, n), Nm, that would be measured, with further ``terms``."""
    own = acting((*model.terms, *terms), "torque")
    motion, pieces = _carrying(model, motion, own)
    torque: Array = pieces.arm_torque + pieces.external_torque
    torque = torque + pieces.payload_mass[:, None] * pieces.payload_torque
    for term in own:
        effect = CATALOGUE[term.effect]
        if motion.load is None and not effect.carried:
            motion = replace(motion, load=torque)
        torque = effect.drive(term, model.arm, torque, motion)
    return torque


def predict_wrench(model: Model, motion: Motion, terms: Sequence[Term] = ()) -> Array:
    """Return the wrenches (N, 6), N and Nm, that the flange sensor would read, with ``terms``.

    Flange axes, about the flange origin, payload included (docs/conventions.md, Loads).
    """
    own = acting((*model.terms, *terms), "wrench")
    motion, pieces = _carrying(model, motion, own)
    wrench = pieces.payload_mass[:, None] * pieces.payload_wrench + pieces.external_wrench
    for term in own:
        wrench = CATALOGUE[term.effect].sense(term, model.arm, wrench, motion)
    return wrench


def predict_tracking(model: Model, motion: Motion, terms: Sequence[Term] = ()) -> Array:
    """Return where the encoders (N, n), rad, would stand for the motion's commands."""
    if motion.target_q is None:
        raise ValueError("the motion has no target_q")
    q = motion.target_q
    if motion.held is None:
        motion = with_held(model, motion)
    for term in acting((*model.terms, *terms), "tracking"):
        q = CATALOGUE[term.effect].track(term, model.arm, q, motion)
    return q


def _carrying(model: Model, motion: Motion, terms: Sequence[Term]) -> tuple[Motion, Pieces]:
    """Return the motion, with pieces that know what the terms add to the payload's mass."""
    pieces = pieces_of(model, motion) if motion.pieces is None else motion.pieces
    more = sum(t.values[0] for t in terms if CATALOGUE[t.effect].adds_mass)
    pieces = replace(pieces, carried_mass=pieces.payload_mass + more)
    return replace(motion, pieces=pieces, load=None), pieces
