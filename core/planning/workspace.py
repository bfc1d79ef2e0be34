"""Where the arm may be measured: joint limits, keep-out boxes, and what the instrument sees.

The arm is taken as capsules between its joint origins, the tool and the load as capsules beyond the
flange, all at the nominal, rigid shape. Coarse on purpose: what is drawn here still has to be
looked at before the arm is moved there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.errors import PlanError
from gapbridge.core.model import Model
from gapbridge.core.planning.capsules import Box, Capsules, below, hidden, in_box, touching

THICK = 0.035  # of the arm's stretched length: radius of a link
TOOL_THICK = 0.03  # of the same: tool and loads
SHORTEST = 1e-3  # m: an arm without length divides nothing by zero
NEAR_SINGULAR = 0.01  # smallest singular value of the Jacobian, lengths in stretched lengths
FURTHEST_TURN = np.pi  # rad from zero, where the limits allow more: cables need not wind up


class Obstacle(Enum):
    """What stands against a pose, in the words of a sentence about such poses."""

    LIMITS = "leave the joint limits"
    BOX = "come into keep-out box {}"
    FLOOR = "come below the floor"
    SELF = "come near the arm itself"
    SINGULAR = "are nearly singular"
    RANGE = "are out of range from place {}"
    TURNED = "turn the reflector away from place {}"
    HIDDEN = "hide the target from place {}"
    FIXED_POINT = "do not reach the fixed point"


class Hindrance(NamedTuple):
    """An obstacle, and the number (from 1) of its box or place; 0: it has none."""

    obstacle: Obstacle
    number: int = 0


@dataclass(frozen=True)
class Place:
    """Where an instrument stands (or the fixed point, or the sphere), in base."""

    position: tuple[float, float, float]  # m
    nearest: float = 0.0  # m, range of the instrument
    farthest: float = np.inf  # m


@dataclass(frozen=True)
class Reflector:
    """What an instrument looks at, in TCP axes."""

    targets: ArrayLike = ((0.0, 0.0, 0.0),)  # (T, 3) m: balls on the tool; the first is the TCP
    looks: ArrayLike | None = None  # (3,) for all targets, or (T, 3) one each; None: all ways
    acceptance: float = np.pi  # rad, half the cone in which a reflector is seen


@dataclass(frozen=True)
class Frames:
    """The rigid arm at N poses, base axes."""

    origin: Array  # (N, n+2, 3) m: base, joints 1..n, flange
    axis: Array  # (N, n, 3) of the joints
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
    floor: float | None  # m, height in base under which nothing may come
    places: tuple[Place, ...]
    targets: Array  # (T, 3) m, TCP axes: balls on the tool; the first is the TCP
    looks: Array | None  # (T, 3) unit vectors, TCP axes: where each reflector looks; None: all ways
    acceptance: float  # rad, half the cone in which a reflector is seen
    radius: Array  # (n+1,) m: links 0 (base to joint 1) to n (last joint to flange)
    tool_radius: float  # m, of the tool and of what hangs on it
    hung: tuple[tuple[float, float, float], ...] = ()  # m, flange axes: how far the loads reach
    pairs: tuple[tuple[int, int], ...] = ()  # capsules that may hit each other

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
        the one target is the TCP, seen from all around.
        Raises PlanError where limits or boxes leave nothing.
        """
        low, high = _limits(model, lower, upper)
        for number, box in enumerate(keep_out, 1):
            if not all(a < b for a, b in zip(box.lower, box.upper, strict=True)):
                raise PlanError(
                    f"keep-out box {number}: found lower {box.lower} and upper {box.upper}, "
                    "expected lower below upper in x, y and z"
                )
        length = max(model.length, SHORTEST)
        radius = np.full(model.arm.n + 1, THICK * length)
        seen = reflector or Reflector()
        points = np.atleast_2d(np.array(seen.targets, dtype=float))
        axes = None
        if seen.looks is not None:
            axes = np.broadcast_to(np.atleast_2d(np.array(seen.looks, dtype=float)), points.shape)
            axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        workspace = cls(
            model, low, high, tuple(keep_out), floor, tuple(places), points, axes, seen.acceptance,
            radius, TOOL_THICK * length,
        )  # fmt: skip
        return replace(workspace, pairs=_pairs(workspace))

    def frames(self, q: Array) -> Frames:
        """Return where everything is at joints ``q`` (N, n), rigid."""
        arm, count = self.model.arm, len(q)
        turn = np.broadcast_to(np.eye(3), (count, 3, 3))
        at = np.zeros((count, 3))
        origins, axes = [at], []
        for i in range(arm.n + 1):
            link = arm.link_in_link[i]
            at = at + turn @ link[:3, 3]
            turn = turn @ link[:3, :3]
            origins.append(at)
            if i < arm.n:
                axes.append(turn[:, :, 2])
                turn = turn @ _about_z(q[:, i])
        tool = self.model.tool_in_flange
        return Frames(
            np.stack(origins, axis=1), np.stack(axes, axis=1), turn,
            at + turn @ tool[:3, 3], turn @ tool[:3, :3],
        )  # fmt: skip

    def capsules(self, frames: Frames) -> Capsules:
        """Return the links, then the tool, then the loads."""
        origin, flange = frames.origin, frames.origin[:, -1]
        ends = [frames.tcp] + [flange + frames.flange @ np.array(point) for point in self.hung]
        begin = np.concatenate([origin[:, :-1], np.stack([flange] * len(ends), axis=1)], axis=1)
        end = np.concatenate([origin[:, 1:], np.stack(ends, axis=1)], axis=1)
        radius = np.concatenate([self.radius, np.full(len(ends), self.tool_radius)])
        return Capsules(begin, end, radius)

    def clear(self, q: Array) -> Mask:
        """Return at which joints (N, n) nothing is hit: limits, boxes, floor, the arm itself."""
        return np.asarray(~np.any(list(self._hits(q, self.frames(q)).values()), axis=0))

    def _hits(self, q: Array, frames: Frames) -> dict[Hindrance, Mask]:
        capsules = self.capsules(frames)
        out = (q < self.lower - 1e-9) | (q > self.upper + 1e-9)
        hits: dict[Hindrance, Mask] = {Hindrance(Obstacle.LIMITS): np.asarray(out.any(axis=1))}
        for number, box in enumerate(self.keep_out, 1):
            hits[Hindrance(Obstacle.BOX, number)] = in_box(capsules, box)
        if self.floor is not None:
            hits[Hindrance(Obstacle.FLOOR)] = below(capsules, self.floor, first=2)
        hits[Hindrance(Obstacle.SELF)] = touching(capsules, self.pairs)
        return hits

    def sees(self, frames: Frames, place: int, target: int) -> dict[Hindrance, Mask]:
        """Return by hindrance at which poses (N,) a target is not seen from a place."""
        where = self.places[place]
        eye = np.array(where.position)
        ball = frames.tcp + frames.rotation @ self.targets[target]
        apart = np.linalg.norm(ball - eye, axis=1)
        out = np.asarray((apart < where.nearest) | (apart > where.farthest))
        missed: dict[Hindrance, Mask] = {Hindrance(Obstacle.RANGE, place + 1): out}
        if self.looks is not None:
            towards = (eye - ball) / np.maximum(apart, 1e-9)[:, None]
            cosine = np.einsum("ni,ni->n", towards, frames.rotation @ self.looks[target])
            turned = np.asarray(cosine < np.cos(self.acceptance))
            missed[Hindrance(Obstacle.TURNED, place + 1)] = turned
        links = self.capsules(frames)
        n = self.model.arm.n
        arm = Capsules(links.begin[:, : n + 1], links.end[:, : n + 1], links.radius[: n + 1])
        missed[Hindrance(Obstacle.HIDDEN, place + 1)] = hidden(arm, eye, ball)
        return missed

    def near_singular(self, frames: Frames) -> Mask:
        """Return at which poses (N,) the arm can hardly move in some direction."""
        length = max(self.model.length, SHORTEST)
        lever = (frames.tcp[:, None] - frames.origin[:, 1:-1]) / length
        J = np.concatenate([np.cross(frames.axis, lever), frames.axis], axis=2)
        smallest = np.linalg.svd(J, compute_uv=False)[:, min(6, self.model.arm.n) - 1]
        return np.asarray(smallest < NEAR_SINGULAR)

    def hindrances(self, q: Array) -> dict[Hindrance, Mask]:
        """Return what stands against which poses (N, n), whatever the instrument."""
        frames = self.frames(q)
        singular = self.near_singular(frames)
        return {**self._hits(q, frames), Hindrance(Obstacle.SINGULAR): singular}

    def draw(self, count: int, random: np.random.Generator) -> Array:
        """Return joints (count, n) anywhere within the limits."""
        return random.uniform(self.lower, self.upper, (count, len(self.lower)))


def _limits(
    model: Model, lower: Sequence[float] | Array | None, upper: Sequence[float] | Array | None
) -> tuple[Array, Array]:
    n, limits = model.arm.n, model.arm.limits
    low, high = limits.lower.copy(), limits.upper.copy()
    for name, given in (("lower", lower), ("upper", upper)):
        if given is not None and len(given) != n:
            raise PlanError(f"joint limits, {name}: found {len(given)} values, expected {n}")
    if lower is not None:
        low = np.maximum(low, np.array(lower, dtype=float))
    if upper is not None:
        high = np.minimum(high, np.array(upper, dtype=float))
    # a joint that may turn further than once round needs to go no further than half round
    round_and_round = (low < -FURTHEST_TURN) & (high > FURTHEST_TURN)
    low = np.where(round_and_round, -FURTHEST_TURN, low)
    high = np.where(round_and_round, FURTHEST_TURN, high)
    low, high = np.maximum(low, -4 * np.pi), np.minimum(high, 4 * np.pi)
    for i in range(n):
        if not low[i] < high[i]:
            raise PlanError(
                f"joint {i + 1}: found limits {low[i]:.4g} to {high[i]:.4g} rad, expected lower "
                "below upper"
            )
    return low, high


def _pairs(workspace: Workspace) -> tuple[tuple[int, int], ...]:
    """Return the capsules far enough along the chain to hit each other in some poses only."""
    frames = workspace.frames(np.zeros((1, workspace.model.arm.n)))
    capsules = workspace.capsules(frames)
    long = np.linalg.norm(capsules.end - capsules.begin, axis=2)[0]
    n = workspace.model.arm.n
    pairs = []
    for j in range(2, len(long)):
        for i in range(min(j - 1, n)):
            between = long[i + 1 : min(j, n + 1)].sum()
            if between > 1.5 * (capsules.radius[i] + capsules.radius[j]):
                pairs.append((i, j))
    return tuple(pairs)


def _about_z(angle: Array) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    turn = np.zeros((len(angle), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = c, -s, s, c
    turn[:, 2, 2] = 1
    return turn
