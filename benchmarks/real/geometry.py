"""Plain least squares for measured positions: frame, tool point, and every link's geometry."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.real.arms import Link, flange

Array = NDArray[np.float64]
USUAL, WRONG = 5e-3, 1e-4  # m and rad of a link's error; m of a measured point


@dataclass(frozen=True)
class Fit:
    """An arm as fitted: changes of its rows, and the tool point of each session."""

    change: Array  # (n, 5)
    tool: Array  # (sessions, 3) m, in the flange frame


def free_numbers(links: tuple[Link, ...]) -> list[tuple[int, int]]:
    """Return which (row, kind) may change: d, a, alpha, angle; the twist where axes are parallel.

    The first row's d and angle and the last row's lengths and angles are the frame's and the
    tool's own.
    """
    out = []
    for i, link in enumerate(links):
        if i == len(links) - 1:
            break
        parallel = abs(np.sin(link.alpha)) < 1e-6
        kinds = [1, 2, 3, 4] if parallel else [0, 1, 2, 3]
        out += [(i, k) for k in kinds if not (i == 0 and k in (0, 3))]
    return out


def registered(p: Array, measured: Array) -> Array:
    """Return points (N, 3) turned and moved onto measured ones (least squares, Umeyama)."""
    return np.asarray((p - p.mean(axis=0)) @ _turn(p, measured).T + measured.mean(axis=0))


def placed(p: Array, measured: Array, fitted: NDArray[np.bool_]) -> Array:
    """Return points (N, 3) in the frame that registers the fitted rows."""
    a, b, R = p[fitted], measured[fitted], _turn(p[fitted], measured[fitted])
    return np.asarray((p - a.mean(axis=0)) @ R.T + b.mean(axis=0))


def points(links: tuple[Link, ...], q: Array, fit: Fit, session: NDArray[np.int64]) -> Array:
    """Return tool points in base (N, 3)."""
    p, R = flange(links, q, fit.change)
    return np.asarray(p + np.einsum("nij,nj->ni", R, fit.tool[session]))


def fit_geometry(
    links: tuple[Link, ...], q: Array, measured: Array, session: NDArray[np.int64],
    tool: Array, *, lengths: bool = True, steps: int = 8,
) -> Fit:  # fmt: skip
    """Return the least-squares arm: frame and tool point a session, and geometry if wanted.

    A prior of 5 mm and 5 mrad beside errors of 0.1 mm keeps directions that the rows do not show
    where they are; it is no news to any other.
    """
    free = free_numbers(links) if lengths else []
    count = int(session.max()) + 1
    change, point = np.zeros((len(links), 5)), np.tile(tool, (count, 1)).astype(float)
    frames = [session == s for s in range(count)]
    for _ in range(steps):
        fit = Fit(change, point)
        base = _turned(points(links, q, fit, session), measured, frames)
        J = np.empty((measured.size, len(free) + 3 * count + 6 * count))
        for k, (i, kind) in enumerate(free):
            moved = change.copy()
            moved[i, kind] += 1e-5
            J[:, k] = _column(links, q, Fit(moved, point), fit, session, measured, frames)
        at = len(free)
        for s in range(count):
            for k in range(3):
                moved_tool = point.copy()
                moved_tool[s, k] += 1e-5
                J[:, at] = _column(
                    links, q, Fit(change, moved_tool), fit, session, measured, frames
                )
                at += 1
            own = frames[s][:, None]
            for k in range(3):
                J[:, at + k] = (own * np.eye(3)[k]).ravel()
                J[:, at + 3 + k] = (own * np.cross(np.eye(3)[k], base)).ravel()
            at += 6
        held = np.eye(J.shape[1])[: len(free)] * (WRONG / USUAL)
        wish = -np.array([change[i, kind] for i, kind in free]) * (WRONG / USUAL)
        step = np.linalg.lstsq(
            np.vstack([J, held]), np.concatenate([(measured - base).ravel(), wish]), rcond=1e-10
        )[0]
        for k, (i, kind) in enumerate(free):
            change[i, kind] += step[k]
        for s in range(count):
            point[s] += step[len(free) + 9 * s : len(free) + 9 * s + 3]
    return Fit(change, point)


def _turned(p: Array, measured: Array, frames: list[NDArray[np.bool_]]) -> Array:
    out = np.empty_like(p)
    for own in frames:
        out[own] = registered(p[own], measured[own])
    return out


def _column(
    links: tuple[Link, ...], q: Array, moved: Fit, fit: Fit, session: NDArray[np.int64],
    measured: Array, frames: list[NDArray[np.bool_]],
) -> Array:  # fmt: skip
    """Return d point / d number in the tracker's axes; the frame held."""
    p = points(links, q, fit, session)
    shift = points(links, q, moved, session) - p
    out = np.empty_like(p)
    for own in frames:
        out[own] = shift[own] @ _turn(p[own], measured[own]).T
    return np.asarray(out.ravel() / 1e-5)


def tool_step(p: Array, R: Array, measured: Array, steps: int = 8) -> Array:
    """Return how far (3,), in the tool's own axes, the target sits from predicted poses.

    ``p`` (N, 3) and ``R`` (N, 3, 3) are the predicted poses; the frame of ``measured`` (N, 3) is
    fitted along.
    """
    t = np.zeros(3)
    for _ in range(steps):
        at = p + R @ t
        placed_, turn = registered(at, measured), _turn(at, measured)
        J = np.zeros((len(p), 3, 9))
        J[:, :, :3], J[:, :, 3:6] = turn @ R, np.eye(3)
        for k in range(3):
            J[:, :, 6 + k] = np.cross(np.eye(3)[k], placed_ - placed_.mean(axis=0))
        t += np.linalg.lstsq(J.reshape(-1, 9), (measured - placed_).ravel(), rcond=1e-10)[0][:3]
    return t


def _turn(p: Array, measured: Array) -> Array:
    """Return the rotation (3, 3) that turns points (N, 3) onto measured ones (Umeyama)."""
    U, _, Vt = np.linalg.svd((p - p.mean(axis=0)).T @ (measured - measured.mean(axis=0)))
    return np.asarray((U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt).T)


def rough_tool(links: tuple[Link, ...], q: Array, measured: Array) -> Array:
    """Return the tool point (3,) that suits the nominal arm best, rounded to 1 mm.

    Raises ValueError where the nominal arm does not fit the points at all.
    """
    session = np.zeros(len(q), dtype=np.int64)
    best, least = np.zeros(3), np.inf
    for start in (np.zeros(3), np.array([0, 0, 0.2]), np.array([0.1, 0, 0.1])):
        fit = fit_geometry(links, q, measured, session, start, lengths=False, steps=25)
        left = measured - registered(points(links, q, fit, session), measured)
        size = float(np.sqrt(np.mean(left**2)))
        if size < least:
            best, least = fit.tool[0], size
    if least > 0.01:
        raise ValueError(f"the nominal arm misses the measured points by {least:.3g} m")
    return np.round(best, 3)


def rough_turn(links: tuple[Link, ...], q: Array, tool: Array, p: Array, R: Array) -> Array:
    """Return roll, pitch and yaw (3,) of the tool that suit the nominal arm best, to 0.01 rad.

    ``p`` (N, 3) and ``R`` (N, 3, 3) were measured at the tool point ``tool`` (3,), flange axes, in
    a frame of the instrument's own.
    """
    from scipy.spatial.transform import Rotation

    at, turned = flange(links, q)
    nominal = at + turned @ tool
    a, b = nominal - nominal.mean(axis=0), p - p.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    frame = (U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt).T
    mounted = Rotation.from_matrix(np.swapaxes(turned, 1, 2) @ frame.T @ R).mean()
    return np.asarray(np.round(mounted.as_euler("xyz"), 2) + 0.0)
