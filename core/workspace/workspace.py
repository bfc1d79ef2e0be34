"""Where the arm may be measured: joint limits, keep-out boxes, and line of sight.

Links are modelled as capsules between joint origins, against boxes also where their centres of
gravity stand beside that line; tool and loads as capsules beyond the flange, all of the nominal
rigid arm. The model is coarse: check a planned pose before the arm moves there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from gapbridge.core.arm import JointLimits
from gapbridge.core.arrays import Array, Mask
from gapbridge.core.dynamics import frames_of
from gapbridge.core.errors import PlanError
from gapbridge.core.model import Model
from gapbridge.core.workspace.capsules import Box, Capsules, below, colliding, in_box, occluded

LINK_RADIUS_SHARE = 0.035  # of the arm's stretched length: radius of a link
TOOL_RADIUS_SHARE = 0.03  # of the same: tool and loads
MIN_LENGTH = 1e-3  # m: an arm without length divides nothing by zero
NEAR_SINGULAR = 0.01  # smallest singular value of the Jacobian, lengths in stretched lengths
MAX_TURN = np.pi  # rad from zero, where the limits allow more: cables need not wind up


class RejectionReason(Enum):
    """Why a pose is rejected; the value completes a sentence about such poses."""

    LIMITS = "leave the joint limits"
    BOX = "come into keep-out box {}"
    FLOOR = "come below the floor"
    SELF = "come near the arm itself"
    SINGULAR = "are nearly singular"
    RANGE = "are out of range from place {}"
    TURNED = "turn the reflector away from place {}"
    HIDDEN = "hide the target from place {}"
    FIXED_POINT = "do not reach the fixed point"


class Rejection(NamedTuple):
    """A reason, and the number (from 1) of its box or place; 0: it has none."""

    reason: RejectionReason
    number: int = 0


@dataclass(frozen=True)
class Place:
    """Where an instrument stands (or the fixed point, or the sphere), in base."""

    position: tuple[float, float, float]  # m
    nearest: float = 0.0  # m, range of the instrument
    farthest: float = np.inf  # m


@dataclass(frozen=True)
class Reflector:
    """The reflectors or balls on the tool that an instrument measures, in TCP axes."""

    targets: ArrayLike = ((0.0, 0.0, 0.0),)  # (T, 3) m: balls on the tool; the first is the TCP
    looks: ArrayLike | None = None  # axes: (3,) for all targets, or (T, 3); None: omnidirectional
    acceptance: float = np.pi  # rad, half the cone in which a reflector is seen


@dataclass(frozen=True)
class Frames:
    """The rigid arm at N poses, base axes."""

    origin: Array  # (N, n+2, 3) m: base, joints 1..n, flange
    axis: Array  # (N, n, 3) of the joints
    centre: Array  # (N, n, 3) m: centres of gravity of the links
    flange: Array  # (N, 3, 3)
    tcp: Array  # (N, 3) m
    rotation: Array  # (N, 3, 3) of the TCP


@dataclass(frozen=True)
class Workspace:
    """The poses at which measuring is possible. Make it by ``Workspace.of``."""

    model: Model
    lower: Array  # (n,) rad
    upper: Array  # (n,) rad
    keep_out: tuple[Box, ...]
    floor: float | None  # m, lowest height in base that link 2 and later ones may reach
    places: tuple[Place, ...]
    targets: Array  # (T, 3) m, TCP axes: balls on the tool; the first is the TCP
    looks: Array | None  # (T, 3) unit vectors, TCP axes: reflector axes; None: omnidirectional
    acceptance: float  # rad, half the cone in which a reflector is seen
    radius: Array  # (n+1,) m: links 0 (base to joint 1) to n (last joint to flange)
    tool_radius: float  # m, of the tool and the loads
    loads_end: tuple[tuple[float, float, float], ...] = ()  # m, flange axes: far end of each load
    pairs: tuple[tuple[int, int], ...] = ()  # capsules checked for collision with each other

    @classmethod
    def of(
        cls,
        model: Model,
        *,
        lower: Sequence[float] | Array | None = None,
        upper: Sequence[float] | Array | None = None,
        keep_out: Sequence[Box] = (),
        floor: float | None = None,
        places: Sequence[Place] = (),
        reflector: Reflector | None = None,
    ) -> Workspace:
        """Return the workspace of an arm in its cell.

        ``lower``, ``upper`` (n, rad) tighten the arm's own joint limits; without a ``reflector``
        the only target is the TCP, visible from all directions.
        Raises PlanError for empty limits or boxes.
        """
        low, high = _limits(model, lower, upper)
        for number, box in enumerate(keep_out, 1):
            if not all(a < b for a, b in zip(box.lower, box.upper, strict=True)):
                raise PlanError(
                    f"keep-out box {number}: found lower {box.lower} and upper {box.upper}, "
                    "expected lower below upper in x, y and z"
                )
        length = max(model.length, MIN_LENGTH)
        radius = np.full(model.arm.n + 1, LINK_RADIUS_SHARE * length)
        optic = reflector or Reflector()
        points = np.atleast_2d(np.array(optic.targets, dtype=float))
        axes = None
        if optic.looks is not None:
            axes = np.broadcast_to(np.atleast_2d(np.array(optic.looks, dtype=float)), points.shape)
            axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        workspace = cls(
            model, low, high, tuple(keep_out), floor, tuple(places), points, axes, optic.acceptance,
            radius, TOOL_RADIUS_SHARE * length,
        )  # fmt: skip
        return replace(workspace, pairs=_pairs(workspace))

    def frames(self, q: Array) -> Frames:
        """Return the frames of the rigid arm at joints ``q`` (N, n), rad."""
        n, still = self.model.arm.n, np.zeros_like(q)
        chain = self.model.without_terms().chain()
        rigid = frames_of(chain, q, still, still)
        flange, origin = rigid.rotation[:, n], rigid.origin[:, n]
        centre = rigid.origin[:, :n] + np.einsum("njab,jb->nja", rigid.rotation[:, :n], chain.cog)
        return Frames(
            np.concatenate([np.zeros((len(q), 1, 3)), rigid.origin], axis=1),
            rigid.rotation[:, :n, :, 2], centre, flange, origin + flange @ chain.tool_position,
            flange @ chain.tool_rotation,
        )  # fmt: skip

    def capsules(self, frames: Frames) -> Capsules:
        """Return the links, then the tool, then the loads."""
        origin, flange = frames.origin, frames.origin[:, -1]
        ends = [frames.tcp] + [flange + frames.flange @ np.array(point) for point in self.loads_end]
        begin = np.concatenate([origin[:, :-1], np.stack([flange] * len(ends), axis=1)], axis=1)
        end = np.concatenate([origin[:, 1:], np.stack(ends, axis=1)], axis=1)
        radius = np.concatenate([self.radius, np.full(len(ends), self.tool_radius)])
        return Capsules(begin, end, radius)

    def beside(self, frames: Frames) -> Capsules:
        """Return the links 1 to n where they stand beside the line between their joints.

        A UR10e's upper arm is 0.18 m beside it, along the joint's axis, and its centre of gravity
        shows that: each link is there, and halfway.
        """
        begin, end = frames.origin[:, 1:-1], frames.origin[:, 2:]
        along = end - begin
        along = along / np.maximum(np.linalg.norm(along, axis=2, keepdims=True), MIN_LENGTH)
        aside = frames.centre - begin
        aside = aside - np.sum(aside * along, axis=2, keepdims=True) * along
        moved = [np.concatenate([side + share * aside for share in (0.5, 1.0)], axis=1)
                 for side in (begin, end)]  # fmt: skip
        return Capsules(moved[0], moved[1], np.tile(self.radius[1:], 2))

    def clear(self, q: Array) -> Mask:
        """Return which joints (N, n) are free of limits, boxes, floor and self-collision (N,)."""
        return np.asarray(~np.any(list(self._hits(q, self.frames(q)).values()), axis=0))

    def _hits(self, q: Array, frames: Frames) -> dict[Rejection, Mask]:
        capsules = self.capsules(frames)
        out = (q < self.lower - 1e-9) | (q > self.upper + 1e-9)
        hits: dict[Rejection, Mask] = {
            Rejection(RejectionReason.LIMITS): np.asarray(out.any(axis=1))
        }
        for number, box in enumerate(self.keep_out, 1):
            inside = in_box(capsules, box) | in_box(self.beside(frames), box)
            hits[Rejection(RejectionReason.BOX, number)] = inside
        if self.floor is not None:
            hits[Rejection(RejectionReason.FLOOR)] = below(capsules, self.floor, first=2)
        hits[Rejection(RejectionReason.SELF)] = colliding(capsules, self.pairs)
        return hits

    def not_visible(self, frames: Frames, place: int, target: int) -> dict[Rejection, Mask]:
        """Return by reason at which poses (N,) a target is not visible from a place."""
        station = self.places[place]
        instrument = np.array(station.position)
        ball = frames.tcp + frames.rotation @ self.targets[target]
        distance = np.linalg.norm(ball - instrument, axis=1)
        out = np.asarray((distance < station.nearest) | (distance > station.farthest))
        rejections: dict[Rejection, Mask] = {Rejection(RejectionReason.RANGE, place + 1): out}
        if self.looks is not None:
            towards = (instrument - ball) / np.maximum(distance, 1e-9)[:, None]
            cosine = np.einsum("ni,ni->n", towards, frames.rotation @ self.looks[target])
            turned = np.asarray(cosine < np.cos(self.acceptance))
            rejections[Rejection(RejectionReason.TURNED, place + 1)] = turned
        capsules = self.capsules(frames)
        n = self.model.arm.n
        arm = Capsules(
            capsules.begin[:, : n + 1], capsules.end[:, : n + 1], capsules.radius[: n + 1]
        )
        rejections[Rejection(RejectionReason.HIDDEN, place + 1)] = occluded(arm, instrument, ball)
        return rejections

    def near_singular(self, frames: Frames) -> Mask:
        """Return at which poses (N,) the arm can hardly move in some direction."""
        length = max(self.model.length, MIN_LENGTH)
        lever = (frames.tcp[:, None] - frames.origin[:, 1:-1]) / length
        J = np.concatenate([np.cross(frames.axis, lever), frames.axis], axis=2)
        smallest = np.linalg.svd(J, compute_uv=False)[:, min(6, self.model.arm.n) - 1]
        return np.asarray(smallest < NEAR_SINGULAR)

    def rejections(self, q: Array) -> dict[Rejection, Mask]:
        """Return by reason which poses (N, n) are rejected, for any instrument."""
        frames = self.frames(q)
        singular = self.near_singular(frames)
        return {**self._hits(q, frames), Rejection(RejectionReason.SINGULAR): singular}

    def draw(self, count: int, random: np.random.Generator) -> Array:
        """Return joints (count, n), rad, uniform within the limits."""
        return random.uniform(self.lower, self.upper, (count, len(self.lower)))


def clear_of_itself(model: Model, q: Array) -> Mask:
    """Return at which joints (N, n), rad, no link or tool comes near another (N,)."""
    unlimited = replace(model.arm, limits=JointLimits.none(model.arm.n))
    workspace = Workspace.of(replace(model, arm=unlimited))
    return ~colliding(workspace.capsules(workspace.frames(q)), workspace.pairs)


def _limits(
    model: Model, lower: Sequence[float] | Array | None, upper: Sequence[float] | Array | None
) -> tuple[Array, Array]:
    n, limits = model.arm.n, model.arm.limits
    low, high = limits.lower.copy(), limits.upper.copy()
    for name, values in (("lower", lower), ("upper", upper)):
        if values is not None and len(values) != n:
            raise PlanError(f"joint limits, {name}: found {len(values)} values, expected {n}")
    if lower is not None:
        low = np.maximum(low, np.array(lower, dtype=float))
    if upper is not None:
        high = np.minimum(high, np.array(upper, dtype=float))
    # a joint with a range beyond a whole turn on either side is used within +-half a turn
    unlimited = (low < -MAX_TURN) & (high > MAX_TURN)
    low = np.where(unlimited, -MAX_TURN, low)
    high = np.where(unlimited, MAX_TURN, high)
    low, high = np.maximum(low, -4 * np.pi), np.minimum(high, 4 * np.pi)
    for i in range(n):
        if not low[i] < high[i]:
            raise PlanError(
                f"joint {i + 1}: found limits {low[i]:.4g} to {high[i]:.4g} rad, expected lower "
                "below upper"
            )
    return low, high


def _pairs(workspace: Workspace) -> tuple[tuple[int, int], ...]:
    """Return pairs of capsules that collide in some poses only: not neighbours in the chain."""
    frames = workspace.frames(np.zeros((1, workspace.model.arm.n)))
    capsules = workspace.capsules(frames)
    length = np.linalg.norm(capsules.end - capsules.begin, axis=2)[0]
    n = workspace.model.arm.n
    pairs = []
    for j in range(2, len(length)):
        for i in range(min(j - 1, n)):
            spacing = length[i + 1 : min(j, n + 1)].sum()
            if spacing > 1.5 * (capsules.radius[i] + capsules.radius[j]):
                pairs.append((i, j))
    return tuple(pairs)
