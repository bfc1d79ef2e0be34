"""Least squares for the flexibilities, with nuisance parameters.

Gauss-Newton on the linear form (eq. 4 of docs/conventions.md), linearised at the deflected shape,
outliers down-weighted. If the instrument is not registered, its frame and the tool point are
nuisances, projected out of the system of the flexibilities.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.estimation import least_squares
from gapbridge.core.estimation.flexibilities import flexibilities
from gapbridge.core.estimation.geometry import Geometry, most_likely_geometry, with_geometry
from gapbridge.core.estimation.least_squares import basis_of, projected_out
from gapbridge.core.estimation.registration import (
    IDENTITY,
    Registration,
    frame_columns,
    register_robustly,
)
from gapbridge.core.estimation.robust import robust_weights, whitening_factors
from gapbridge.core.kernels.factor import factor_blocks
from gapbridge.core.kernels.threads import in_ranges
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model, Poses
from gapbridge.core.rotation import rotation_vector

ROUNDS = 12
NUISANCE_ROUNDS = 20
CONVERGED = 1e-8  # relative step at which a fit has converged
RANK = 1e-10  # singular values of the nuisances below this share are rounding
QR_ROWS = 2000  # rows of one decomposition, for speed


@dataclass(frozen=True)
class Data:
    """Measured poses and loads of N rows."""

    q: Array  # (N, n) rad
    loads: Loads
    position: Array  # (N, 3) m, measured, instrument's frame
    rotation: Array | None  # (N, 3, 3)
    registered: bool  # the instrument measures the cell's TCP in base: no nuisances
    session: NDArray[np.int64] | None = None  # (N,) session of each row; None: there is one
    sessions: int = 1  # number of sessions in the whole data
    remounted: bool = False  # each session has a separate tool point
    stretch: NDArray[np.int64] | None = None  # (N,) of time, in a recording of motion

    def part(self, rows: NDArray[Any] | slice) -> Data:
        """Return some of the rows."""
        rotation = None if self.rotation is None else self.rotation[rows]
        session, stretch = (c if c is None else c[rows] for c in (self.session, self.stretch))
        return replace(
            self, q=self.q[rows], loads=self.loads[rows], position=self.position[rows],
            rotation=rotation, session=session, stretch=stretch,
        )  # fmt: skip

    @property
    def frames(self) -> int:
        """Return how many frames of the instrument are unknown."""
        return 0 if self.registered else self.sessions

    @property
    def tools(self) -> int:
        """Return how many tool points are unknown."""
        if self.remounted:
            return self.sessions
        return 0 if self.registered else 1

    @property
    def nuisances(self) -> int:
        """Return the number of nuisance parameters: 6 per frame, 3 per tool point."""
        return 6 * self.frames + 3 * self.tools


@dataclass(frozen=True)
class Placements:
    """Frame of the instrument and tool point of each of several sessions."""

    frames: tuple[Registration, ...]
    tool_shift: tuple[Array, ...]  # (3,) m, flange axes, relative to the model's tool point


@dataclass(frozen=True)
class ProjectedSystem:
    """The linearised system, divided by the noise, nuisances projected out.

    matrix @ flexibilities = right for the flexibilities (2n,) themselves, not for a step.
    """

    matrix: Array  # (2n+1, 2n) per rad/Nm
    right: Array  # (2n+1,)

    def over(self, noise: float) -> ProjectedSystem:
        """Return the system of a noise that is larger by this factor."""
        return ProjectedSystem(self.matrix / noise, self.right / noise)


@dataclass(frozen=True)
class Fit:
    """State of a fit that has converged."""

    model: Model  # with the estimated flexibilities and tool point
    frame: Registration | Placements
    weights: Array  # (N,)
    linear: ProjectedSystem | None = None  # None: only the nuisances were fitted
    geometry: Geometry | None = None  # geometry parameters in the model that were estimated

    @property
    def flexibility(self) -> Array:
        """Return the flexibilities (2n,) rad/Nm: axial, then radial."""
        return flexibilities(self.model)


def residual(model: Model, data: Data, frame: Registration | Placements) -> tuple[Array, Poses]:
    """Return measured minus predicted (N, 3 or 6) in base axes, and the predicted poses."""
    if isinstance(frame, Placements):
        return _residual_by_session(model, data, frame)
    poses = model.predict(data.q, data.loads)
    gap = frame.in_base(data.position) - poses.position
    if data.rotation is None:
        return gap, poses
    rotation_error = frame.rotation_in_base(data.rotation) @ np.swapaxes(poses.rotation, 1, 2)
    return np.hstack([gap, rotation_vector(rotation_error)]), poses


def _residual_by_session(model: Model, data: Data, placements: Placements) -> tuple[Array, Poses]:
    gap = np.empty((len(data.q), 3 if data.rotation is None else 6))
    position, rotation = np.empty((len(data.q), 3)), np.empty((len(data.q), 3, 3))
    assert data.session is not None
    for s, (frame, shift) in enumerate(zip(placements.frames, placements.tool_shift, strict=True)):
        rows = np.flatnonzero(data.session == s)
        if len(rows):
            part = replace(data.part(rows), session=None, sessions=1)
            gap[rows], poses = residual(shifted(model, shift), part, frame)
            position[rows], rotation[rows] = poses.position, poses.rotation
    return gap, Poses(position, rotation)


def shifted(model: Model, tool_shift: Array) -> Model:
    """Return the model with its tool point moved by ``tool_shift`` (3,), m, flange axes."""
    tool = model.tool_in_flange.copy()
    tool[:3, 3] += tool_shift
    return replace(model, tool_in_flange=tool)


def nuisance_columns(model: Model, poses: Poses, width: int, data: Data | None = None) -> Array:
    """Return d(measured minus predicted) / d(frame step, tool point) as (N, width, 9), negated.

    Of several sessions (``data``): all frames first, then the tool points, (N, width, nuisances).
    """
    columns = np.zeros((len(poses.position), width, 9))
    columns[:, :, :6] = -frame_columns(poses.position)[:, :width]
    columns[:, :3, 6:] = poses.rotation @ model.tool_in_flange[:3, :3].T  # flange axes in base
    if data is None or data.session is None:
        return columns
    placed = np.zeros((len(columns), width, data.nuisances))
    for s in range(data.sessions):
        rows = data.session == s
        if data.frames:
            placed[rows, :, 6 * s : 6 * s + 6] = columns[rows, :, :6]
        first = 6 * data.frames + (3 * s if data.remounted else 0)
        if data.tools:
            placed[rows, :, first : first + 3] = columns[rows, :, 6:]
    return placed


def fit_nuisances(
    model: Model, data: Data, begin: Registration | Placements | None = None,
    converged: float = CONVERGED,
) -> Fit:  # fmt: skip
    """Return the fit of frame and tool point, with the model's flexibilities.

    ``begin`` is a start of the frame, None: by registration. ``converged`` is the final step (m,
    rad).
    """
    if not data.nuisances:
        gap, _ = residual(model, data, IDENTITY)
        return Fit(model, IDENTITY, robust_weights(gap)[0])
    return _fit_placements(model, data, slice(None), begin, converged)


def gap_after_registration(model: Model, data: Data) -> Array:
    """Return the residual (N, 3 or 6) of one session after fitting its own frame.

    Its tool point is fitted too if remounted, nothing else. A registered instrument has no frame to
    fit.
    """
    one = replace(data, session=np.zeros(len(data.q), dtype=np.int64), sessions=1)
    if not one.nuisances:
        return residual(model, one, IDENTITY)[0]
    free = slice(0, one.nuisances if one.remounted else 6 * one.frames)
    fit = _fit_placements(model, one, free)
    return residual(fit.model, one, fit.frame)[0]


def _fit_placements(
    model: Model, data: Data, free: slice, begin: Registration | Placements | None = None,
    converged: float = CONVERGED,
) -> Fit:  # fmt: skip
    """Return the fit of the nuisances ``free``, the others held."""
    frame = begin or _initial_placements(model, data)
    for _ in range(NUISANCE_ROUNDS):
        gap, poses = residual(model, data, frame)
        weights, scale = robust_weights(gap)
        per_cell = whitening_factors(weights, scale, gap.shape[1])
        columns = nuisance_columns(model, poses, gap.shape[1], data)[:, :, free]
        step = np.zeros(data.nuisances)
        flat = np.concatenate([columns, gap[..., None]], axis=2) * per_cell[..., None]
        R = r_factor(flat.reshape(gap.size, -1))
        step[free] = least_squares.solve(R[:, :-1], R[:, -1], rank=RANK)
        model, frame = with_step(model, frame, step)
        if np.abs(step).max(initial=0.0) < converged:
            break
    return Fit(model, frame, weights)


def _initial_placements(model: Model, data: Data) -> Registration | Placements:
    """Return the registered frame of each session, outliers down-weighted."""
    predicted = model.predict(data.q, data.loads).position
    if data.session is None:
        return register_robustly(data.position, predicted)
    frames = [
        register_robustly(data.position[rows], predicted[rows])
        if not data.registered and rows.any() else IDENTITY
        for rows in (data.session == s for s in range(data.sessions))
    ]  # fmt: skip
    return Placements(tuple(frames), (np.zeros(3),) * data.sessions)


def fit_flexibilities(
    begin: Fit, data: Data, kept: Mask, prior: tuple[Array, float], rounds: int = ROUNDS,
    converged: float = CONVERGED,
) -> Fit:  # fmt: skip
    """Return the fit of the ``kept`` flexibilities (2n,), the others as they are in ``begin``.

    ``prior``: mean (2n,) and 1 sigma, rad/Nm; ``converged``: the final relative step.
    """
    fit = begin
    for _ in range(rounds):
        before = fit.flexibility
        fit = _iterate(fit, data, kept, prior)
        if np.abs(fit.flexibility - before).max() < converged * max(np.abs(before).max(), 1e-12):
            break
    return fit


def _iterate(fit: Fit, data: Data, kept: Mask, prior: tuple[Array, float]) -> Fit:
    """Return the fit after one Gauss-Newton step on all rows."""
    n = fit.model.arm.n
    R, weights = _factor(fit, data, fit.geometry)
    problem = (R[:, : -2 * n - 1], R[:, -2 * n - 1 : -1], R[:, -1])
    return gauss_newton_step(fit, problem, weights, kept, prior)


def _factor(fit: Fit, data: Data, geometry: Geometry | None = None) -> tuple[Array, Array]:
    """Return ``weighted_factor`` linearised at a fit, and the rows' weights (N,) there."""
    gap, poses = residual(fit.model, data, fit.frame)
    weights, scale = robust_weights(gap)
    cells = (gap, whitening_factors(weights, scale, gap.shape[1]))
    return weighted_factor(fit.model, fit.frame, data, cells, poses, geometry), weights


def weighted_factor(
    model: Model, frame: Registration | Placements, data: Data, cells: tuple[Array, Array],
    poses: Poses | None = None, geometry: Geometry | None = None,
) -> Array:  # fmt: skip
    """Return the R factor of [geometry | nuisances | flexibilities | gap], linearised at the model.

    ``cells``: gap and factor of each equation (N, width); ``poses``: the predicted ones. The prior
    of the geometry is included.
    """
    gap, per_cell = cells
    if data.session is None and geometry is None:
        k = data.nuisances + 2 * model.arm.n + 1
        R = np.zeros((k, k))
        add_rows(model, data, gap, per_cell, R)
        return R
    width = gap.shape[1]
    columns = [regressor(model, data, frame)[:, :width], gap[..., None]]
    if data.nuisances:
        poses = poses or model.predict(data.q, data.loads)
        columns.insert(0, nuisance_columns(model, poses, width, data))
    if geometry is not None:
        columns.insert(0, geometry.columns(model, data.q, data.loads, width))
    whitened = np.concatenate(columns, axis=2) * per_cell[..., None]
    R = r_factor(whitened.reshape(gap.size, -1))
    if geometry is not None:
        prior_rows = np.zeros((len(geometry.sigma), R.shape[1]))
        np.fill_diagonal(prior_rows, 1 / geometry.sigma)
        prior_rows[:, -1] = -geometry.prior(model)
        R = r_factor(np.vstack([R, prior_rows]))
    return R


def add_rows(model: Model, data: Data, gap: Array, cells: Array, R: Array) -> None:
    """Fold rows into R: linearised columns, ``gap`` and factors ``cells`` (N, width)."""
    chain, rows = model.chain(), model.rows(data.q, data.loads)
    nuisances, stopped_at = data.nuisances, [0]
    if not chain.flexibility.any():
        parts: list[Array] = []

        def work(first: int, last: int) -> int:
            part = np.zeros_like(R)
            parts.append(part)
            return int(factor_blocks(chain, rows, gap, cells, first, last, part))

        stopped_at = in_ranges(work, len(gap))
        if max(stopped_at) < 0:
            fold_rows(R, *parts)
            return
    # deflections too large for the block kernel, or flexible links: columns in memory
    width = gap.shape[1]
    columns = [model.linear_form(data.q, data.loads).regressor[:, :width], gap[..., None]]
    if nuisances:
        columns.insert(0, nuisance_columns(model, model.predict(data.q, data.loads), width))
    whitened = np.concatenate(columns, axis=2) * cells[..., None]
    fold_rows(R, whitened.reshape(-1, len(R)))


def fold_rows(R: Array, *parts: Array) -> None:
    """Fold further rows, or R factors of them, into R (k, k)."""
    folded = np.linalg.qr(np.vstack([R, *parts]), mode="r")
    R[:] = 0.0
    R[: len(folded)] = folded


def r_factor(rows: Array) -> Array:
    """Return the R factor of rows (M, k), a few thousand of them at a time."""
    R = rows[:0]
    for begin in range(0, len(rows), QR_ROWS):
        R = np.asarray(np.linalg.qr(np.vstack([R, rows[begin : begin + QR_ROWS]]), mode="r"))
    return R


def regressor(model: Model, data: Data, frame: Registration | Placements) -> Array:
    """Return the linear form's columns (N, 6, 2n), each session with its own tool point."""
    if not isinstance(frame, Placements):
        return model.linear_form(data.q, data.loads).regressor
    assert data.session is not None
    columns = np.empty((len(data.q), 6, 2 * model.arm.n))
    for s, shift in enumerate(frame.tool_shift):
        rows = np.flatnonzero(data.session == s)
        if len(rows):
            form = shifted(model, shift).linear_form(data.q[rows], data.loads[rows])
            columns[rows] = form.regressor
    return columns


def gauss_newton_step(
    fit: Fit,
    problem: tuple[Array, Array, Array],
    weights: Array,
    kept: Mask,
    prior: tuple[Array, float],
) -> Fit:
    """Return the fit after one Gauss-Newton step.

    ``problem``: columns of the nuisances (M, 0 or 9), of the flexibilities (M, 2n), and the gap
    (M,), all weighted; or those of their R factor.
    """
    F, A, b = problem
    model, frame, flexibility = fit.model, fit.frame, fit.flexibility
    linear = _projected(A, b + A @ flexibility, basis_of(F, RANK))
    solution = solve(linear, kept, flexibility, prior)
    if F.shape[1]:
        remaining = b - A @ (solution - flexibility)
        step = least_squares.solve(F, remaining, rank=RANK)
        if fit.geometry is not None:
            count = len(fit.geometry.sigma)
            model, step = fit.geometry.moved(model, step[:count]), step[count:]
        if len(step):
            model, frame = with_step(model, frame, step)
    n = model.arm.n
    model = model.with_compliance(solution[:n], solution[n:])
    return Fit(model, frame, weights, linear, fit.geometry)


def with_free_geometry(fit: Fit, data: Data) -> Fit:
    """Return the fit with the geometry as further nuisances if that is more likely.

    They include the tool point if it is not a nuisance already.
    """
    gap, poses = residual(fit.model, data, fit.frame)
    weights, scale = robust_weights(gap)
    model, geometry = with_geometry(fit.model, tool=not data.tools)
    width, n = gap.shape[1], model.arm.n
    if gap.size <= data.nuisances + 2 * n:
        return fit
    columns = [regressor(fit.model, data, fit.frame)[:, :width]]
    if data.nuisances:
        columns.insert(0, nuisance_columns(fit.model, poses, width, data))
    columns += [geometry.columns(model, data.q, data.loads, width), gap[..., None]]
    whitened = np.concatenate(columns, axis=2) * whitening_factors(weights, scale, width)[..., None]
    R, cells = r_factor(whitened.reshape(gap.size, -1)), width * float(weights.sum())
    best = most_likely_geometry(R, data.nuisances + 2 * n, cells, geometry)
    return fit if best is None else replace(fit, model=model, geometry=best)


def projected(fit: Fit, data: Data, geometry: Geometry | None) -> ProjectedSystem:
    """Return the system linearised at a fit, its nuisances (and ``geometry``) projected out."""
    R, n = _factor(fit, data, geometry)[0], fit.model.arm.n
    F, A, b = R[:, : -2 * n - 1], R[:, -2 * n - 1 : -1], R[:, -1]
    return _projected(A, b + A @ fit.flexibility, basis_of(F, RANK))


def tool_std(fit: Fit, data: Data) -> float:
    """Return the largest 1 sigma (m) of the tool point over all directions, frames projected out.

    Infinite unless exactly one tool point is estimated.
    """
    if data.tools != 1:
        return np.inf
    R = _factor(fit, data)[0]
    tool = 6 * data.frames + np.arange(3)
    projected_tool = projected_out(basis_of(R[:, : tool[0]], RANK), R[:, tool])
    return 1 / max(float(np.linalg.svd(projected_tool, compute_uv=False)[-1]), 1e-300)


def as_cell_model(fit: Fit, data: Data) -> Fit:
    """Return the fit as the cell stores it: nominal links, frames and tool points refitted.

    With a registered instrument the tool point changes only if it is the only geometry error.
    """
    if fit.geometry is None:
        return fit
    model = fit.geometry.written(fit.model)
    if not data.nuisances:
        return replace(fit, model=model, geometry=None)
    return replace(_fit_placements(model, data, slice(None)), weights=fit.weights)


def _projected(A: Array, b: Array, Q: Array) -> ProjectedSystem:
    """Return the system with nuisances ``Q`` projected out, reduced by QR."""
    R = np.asarray(np.linalg.qr(projected_out(Q, np.column_stack([A, b])), mode="r"))
    return ProjectedSystem(R[:, :-1], R[:, -1])


def solve(linear: ProjectedSystem, kept: Mask, values: Array, prior: tuple[Array, float]) -> Array:
    """Return the flexibilities (2n,) that solve the system, 0 or more; only ``kept`` change."""
    centre, sigma = prior
    solution, count = values.copy(), int(kept.sum())
    if not count:
        return solution
    rows = np.vstack([linear.matrix[:, kept], np.eye(count) / sigma])
    right = np.concatenate(
        [linear.right - linear.matrix[:, ~kept] @ values[~kept], centre[kept] / sigma]
    )
    solution[kept] = least_squares.bounded(rows, right, np.zeros(count), np.full(count, np.inf))[0]
    return solution


def with_step(
    model: Model, frame: Registration | Placements, step: NDArray[Any]
) -> tuple[Model, Registration | Placements]:
    """Return model and frames after a step of the nuisances: frame (6,), tool point (3,).

    Of several sessions: all frames, then one tool point, or one each where they were remounted.
    """
    if not isinstance(frame, Placements):
        return shifted(model, step[6:]), frame.moved(step[:6])
    count = len(frame.frames)
    tools = len(step) - 6 * count if len(step) >= 6 * count else len(step)
    frame_steps, tool_steps = step[: len(step) - tools], step[len(step) - tools :].reshape(-1, 3)
    frames = frame.frames
    if len(frame_steps):
        steps = frame_steps.reshape(count, 6)
        frames = tuple(f.moved(p) for f, p in zip(frames, steps, strict=True))
    if len(tool_steps) == 1:
        return shifted(model, tool_steps[0]), replace(frame, frames=frames)
    shifts = tuple(a + b for a, b in zip(frame.tool_shift, tool_steps, strict=True))
    return model, Placements(frames, shifts)
