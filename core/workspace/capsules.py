"""Arms as chains of capsules: distances between segments, and from segments to boxes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array, Mask

TINY = 1e-12
MAX_SPACING = 0.02  # m, between points of a segment that are checked against a box


@dataclass(frozen=True)
class Box:
    """A keep-out box, aligned with base axes."""

    lower: tuple[float, float, float]  # m
    upper: tuple[float, float, float]  # m


@dataclass(frozen=True)
class Capsules:
    """C capsules at each of N poses: segments of base, with a radius each."""

    begin: Array  # (N, C, 3) m
    end: Array  # (N, C, 3) m
    radius: Array  # (C,) m


def segment_distance(p: Array, q: Array, r: Array, s: Array) -> Array:
    """Return the distance between segments p-q and r-s, all (..., 3).

    Source: Ericson, Real-Time Collision Detection (2005), 5.1.9.
    """
    u, v, w = q - p, s - r, p - r
    a, e = np.sum(u * u, axis=-1), np.sum(v * v, axis=-1)
    b, c, f = np.sum(u * v, axis=-1), np.sum(u * w, axis=-1), np.sum(v * w, axis=-1)
    denominator = a * e - b * b
    # parallel, or one is a point: project the start of the second segment onto the first
    perpendicular = np.where(a > TINY, -c / np.maximum(a, TINY), 0.0)
    skewed = (a > TINY) & (e > TINY) & (denominator > TINY * a * e)
    along = np.where(skewed, (b * f - c * e) / np.where(skewed, denominator, 1.0), perpendicular)
    along = np.clip(along, 0, 1)
    across = np.where(e > TINY, (b * along + f) / np.maximum(e, TINY), 0.0)
    clipped = np.clip(across, 0, 1)
    again = np.where(a > TINY, (b * clipped - c) / np.maximum(a, TINY), 0.0)
    along = np.where(clipped != across, np.clip(again, 0, 1), along)
    gap = w + along[..., None] * u - clipped[..., None] * v
    return np.asarray(np.linalg.norm(gap, axis=-1))


def in_box(capsules: Capsules, box: Box) -> Mask:
    """Return at which poses (N,) a capsule intersects the box."""
    lower, upper = np.array(box.lower), np.array(box.upper)
    hit = np.zeros(len(capsules.begin), dtype=bool)
    for i, radius in enumerate(capsules.radius):
        begin, end = capsules.begin[:, i], capsules.end[:, i]
        longest = float(np.linalg.norm(end - begin, axis=1).max(initial=0.0))
        count = int(np.ceil(longest / max(0.5 * float(radius), MAX_SPACING))) + 1
        for share in np.linspace(0, 1, count):
            point = begin + share * (end - begin)
            offset = point - np.clip(point, lower, upper)
            hit |= np.sum(offset**2, axis=1) < radius**2
    return hit


def below(capsules: Capsules, height: float, first: int) -> Mask:
    """Return at which poses (N,) a capsule from ``first`` on is below a height (m, base)."""
    lowest = np.minimum(capsules.begin[:, first:, 2], capsules.end[:, first:, 2])
    return np.asarray((lowest - capsules.radius[first:] < height).any(axis=1))


def colliding(capsules: Capsules, pairs: tuple[tuple[int, int], ...]) -> Mask:
    """Return at which poses (N,) the capsules of a pair intersect."""
    hit = np.zeros(len(capsules.begin), dtype=bool)
    for i, j in pairs:
        distance = segment_distance(
            capsules.begin[:, i], capsules.end[:, i], capsules.begin[:, j], capsules.end[:, j]
        )
        hit |= distance < capsules.radius[i] + capsules.radius[j]
    return hit


def occluded(capsules: Capsules, viewpoint: Array, target: Array) -> Mask:
    """Return at which poses (N,) a capsule blocks the view from (3,) to a target (N, 3), m, base.

    A target closer to a capsule's axis than its radius is mounted on it: the radius is then reduced
    so that the target is outside.
    """
    hit = np.zeros(len(target), dtype=bool)
    for i, radius in enumerate(capsules.radius):
        begin, end = capsules.begin[:, i], capsules.end[:, i]
        clearance = segment_distance(target, target, begin, end)
        distance = segment_distance(np.broadcast_to(viewpoint, target.shape), target, begin, end)
        hit |= distance < np.minimum(radius, 0.9 * clearance)
    return hit
