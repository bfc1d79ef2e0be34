"""The least squares behind the identification: flexibilities, and what is unknown beside them.

Gauss-Newton on the linear form (eq. 4 of docs/conventions.md), taken again at the deflected shape,
outliers down-weighted. Where the instrument is not registered, its frame and the tool point are
estimated along: nuisances, projected out before anything is said of a flexibility.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.effects.effect import typical_moment
from gapbridge.core.estimation import least_squares
from gapbridge.core.estimation.geometry import Geometry, likelier, with_geometry
from gapbridge.core.estimation.least_squares import basis_of, projected_out
from gapbridge.core.estimation.registration import (
    IDENTITY,
    Registration,
    frame_columns,
    register_robustly,
)
from gapbridge.core.estimation.robust import distance_of, scale_of, weights_of
from gapbridge.core.kernels.factor import factor_blocks
from gapbridge.core.kernels.threads import in_ranges
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model, Poses
from gapbridge.core.rotation import rotation_vector

ROUNDS = 12
NUISANCE_ROUNDS = 20
CONVERGED = 1e-8  # relative step at which a fit has converged
RANK = 1e-10  # singular values of the nuisances below this share are rounding
AT_ONCE = 2000  # rows of one decomposition; of 60,000 by 22 columns it takes 9 ms, whole 24 ms


@dataclass(frozen=True)
class Data:
    """Measured poses of N rows and what acted on the arm."""

    q: Array  # (N, n) rad
    loads: Loads
    position: Array  # (N, 3) m, measured, instrument's frame
    rotation: Array | None  # (N, 3, 3)
    registered: bool  # the instrument measures the cell's TCP in base: nothing beside is unknown
    session: NDArray[np.int64] | None = None  # (N,) session of each row; None: there is one
    sessions: int = 1  # how many there are, in the whole data
    remounted: bool = False  # each session has a tool point of its own

    def part(self, rows: NDArray[Any] | slice) -> Data:
        """Return some of the rows."""
        rotation = None if self.rotation is None else self.rotation[rows]
        session = None if self.session is None else self.session[rows]
        return replace(
            self, q=self.q[rows], loads=self.loads[rows], position=self.position[rows],
            rotation=rotation, session=session,
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
        """Return how many numbers are estimated beside the flexibilities: frames, tool points."""
        return 6 * self.frames + 3 * self.tools


@dataclass(frozen=True)
class Placements:
    """Where the instrument stood, and where the target sat, in each of several sessions."""

    frames: tuple[Registration, ...]
    tool_shift: tuple[Array, ...]  # (3,) m, flange axes: against the model's tool point


@dataclass(frozen=True)
class Linear:
    """The problem at one shape, weighed by the noise, nuisances projected out.

    matrix @ flexibilities = right for the flexibilities (2n,) themselves, not for a step.
    """

    matrix: Array  # (2n+1, 2n) per rad/Nm
    right: Array  # (2n+1,)


@dataclass(frozen=True)
class Fit:
    """State of a fit that has converged."""

    model: Model  # with the flexibilities and the tool point found
    frame: Registration | Placements
    weights: Array  # (N,)
    linear: Linear | None = None  # None: only the nuisances were fitted
    geometry: Geometry | None = None  # numbers in the model that were estimated along, if any

    @property
    def flexibility(self) -> Array:
        """Return the flexibilities (2n,) rad/Nm: axial, then radial."""
        return flexibilities(self.model)


def flexibilities(model: Model) -> Array:
    """Return the model's linear flexibilities (2n,) rad/Nm: axial, then radial.

    Those that ``with_compliance`` replaces; what a bent stiffness curve holds stays beside.
    """
    found = np.zeros(2 * model.arm.n)
    for term in model.terms:
        kind = CATALOGUE[term.effect].flexibility
        if kind and term.site.joint:
            first = 0 if kind == "axial" else model.arm.n
            found[first + term.site.joint - 1] += term.values[0]
    return found


def usual_flexibility(model: Model) -> float:
    """Return a usual flexibility (rad/Nm) of a joint of an arm of this size."""
    return 1e-3 / typical_moment(model.arm)


def prior_of(model: Model) -> tuple[Array, float]:
    """Return the value (2n,) and the 1 sigma (rad/Nm) that weakly hold every flexibility."""
    return flexibilities(model), 10 * usual_flexibility(model)


def residual(model: Model, data: Data, frame: Registration | Placements) -> tuple[Array, Poses]:
    """Return measured minus predicted (N, 3 or 6) in base axes, and the predicted poses."""
    if isinstance(frame, Placements):
        return _residual_by_session(model, data, frame)
    poses = model.predict(data.q, data.loads)
    gap = frame.in_base(data.position) - poses.position
    if data.rotation is None:
        return gap, poses
    turn = frame.rotation_in_base(data.rotation) @ np.swapaxes(poses.rotation, 1, 2)
    return np.hstack([gap, rotation_vector(turn)]), poses


def _residual_by_session(model: Model, data: Data, placements: Placements) -> tuple[Array, Poses]:
    gap = np.empty((len(data.q), 3 if data.rotation is None else 6))
    position, rotation = np.empty((len(data.q), 3)), np.empty((len(data.q), 3, 3))
    assert data.session is not None
    for s, (frame, shift) in enumerate(zip(placements.frames, placements.tool_shift, strict=True)):
        rows = np.flatnonzero(data.session == s)
        if len(rows):
            own = replace(data.part(rows), session=None, sessions=1)
            gap[rows], poses = residual(shifted(model, shift), own, frame)
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
    whole = np.zeros((len(columns), width, data.nuisances))
    for s in range(data.sessions):
        rows = data.session == s
        if data.frames:
            whole[rows, :, 6 * s : 6 * s + 6] = columns[rows, :, :6]
        at = 6 * data.frames + (3 * s if data.remounted else 0)
        if data.tools:
            whole[rows, :, at : at + 3] = columns[rows, :, 6:]
    return whole


def fit_nuisances(
    model: Model, data: Data, begin: Registration | Placements | None = None,
    converged: float = CONVERGED,
) -> Fit:  # fmt: skip
    """Return the frame and tool point that fit best, the model's flexibilities left alone.

    ``begin`` is a frame near it, as the model's tool point is then; None: they are searched for.
    ``converged`` is the step (m, rad) at which it ends.
    """
    if not data.nuisances:
        gap, _ = residual(model, data, IDENTITY)
        return Fit(model, IDENTITY, robust_weights(gap)[0])
    return _placed(model, data, slice(None), begin, converged)


def placed_gap(model: Model, data: Data) -> Array:
    """Return what a model leaves (N, 3 or 6) of one session whose frame is fitted on itself.

    So is its tool point where it was remounted; nothing else of the model moves. A registered
    instrument has no frame to fit.
    """
    one = replace(data, session=np.zeros(len(data.q), dtype=np.int64), sessions=1)
    if not one.nuisances:
        return residual(model, one, IDENTITY)[0]
    free = slice(0, one.nuisances if one.remounted else 6 * one.frames)
    fit = _placed(model, one, free)
    return residual(fit.model, one, fit.frame)[0]


def _placed(
    model: Model, data: Data, free: slice, begin: Registration | Placements | None = None,
    converged: float = CONVERGED,
) -> Fit:  # fmt: skip
    """Return the fit of the nuisances ``free``, the others left where they are."""
    frame = begin or _first_placements(model, data)
    for _ in range(NUISANCE_ROUNDS):
        gap, poses = residual(model, data, frame)
        weights, scale = robust_weights(gap)
        per_cell = per_cell_of(weights, scale, gap.shape[1])
        columns = nuisance_columns(model, poses, gap.shape[1], data)[:, :, free]
        step = np.zeros(data.nuisances)
        flat = np.concatenate([columns, gap[..., None]], axis=2) * per_cell[..., None]
        R = r_factor(flat.reshape(gap.size, -1))
        step[free] = least_squares.solve(R[:, :-1], R[:, -1], rank=RANK)
        model, frame = moved(model, frame, step)
        if np.abs(step).max(initial=0.0) < converged:
            break
    return Fit(model, frame, weights)


def _first_placements(model: Model, data: Data) -> Registration | Placements:
    """Return the frame of each session as the rigid arm has it, outliers down-weighted."""
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

    ``prior`` is the value (2n,) and the 1 sigma (rad/Nm) that weakly hold every flexibility;
    ``converged`` the relative step at which it ends.
    """
    now = begin
    for _ in range(rounds):
        before = now.flexibility
        now = _round(now, data, kept, prior)
        if np.abs(now.flexibility - before).max() < converged * max(np.abs(before).max(), 1e-12):
            break
    return now


def _round(now: Fit, data: Data, kept: Mask, prior: tuple[Array, float]) -> Fit:
    """Take one step of Gauss and Newton."""
    n = now.model.arm.n
    R, weights = _factor(now, data, now.geometry)
    problem = (R[:, : -2 * n - 1], R[:, -2 * n - 1 : -1], R[:, -1])
    return stepped(now, problem, weights, kept, prior)


def _factor(fit: Fit, data: Data, geometry: Geometry | None = None) -> tuple[Array, Array]:
    """Return what ``weighed`` does at the shape of a fit, and the rows' weights (N,) there."""
    gap, poses = residual(fit.model, data, fit.frame)
    weights, scale = robust_weights(gap)
    cells = (gap, per_cell_of(weights, scale, gap.shape[1]))
    return weighed(fit.model, fit.frame, data, cells, poses, geometry), weights


def weighed(
    model: Model, frame: Registration | Placements, data: Data, cells: tuple[Array, Array],
    poses: Poses | None = None, geometry: Geometry | None = None,
) -> Array:  # fmt: skip
    """Return the R factor of [geometry | nuisances | flexibilities | gap] at the model's shape.

    ``cells``: gap and what each cell is multiplied by (N, width); ``poses``: as predicted. What
    is known of the geometry beforehand is in it.
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
    whole = np.concatenate(columns, axis=2) * per_cell[..., None]
    R = r_factor(whole.reshape(gap.size, -1))
    if geometry is not None:
        held = np.zeros((len(geometry.sigma), R.shape[1]))
        np.fill_diagonal(held, 1 / geometry.sigma)
        held[:, -1] = -geometry.prior(model)
        R = r_factor(np.vstack([R, held]))
    return R


def add_rows(model: Model, data: Data, gap: Array, cells: Array, R: Array) -> None:
    """Fold rows into R: columns at the model's shape, ``gap`` and factors ``cells`` (N, width)."""
    chain, rows = model.chain(), model.rows(data.q, data.loads)
    nuisances, stopped = data.nuisances, [0]
    if not chain.flexibility.any():
        parts: list[Array] = []

        def work(first: int, last: int) -> int:
            own = np.zeros_like(R)
            parts.append(own)
            return int(factor_blocks(chain, rows, gap, cells, first, last, own))

        stopped = in_ranges(work, len(gap))
        if max(stopped) < 0:
            fold_rows(R, *parts)
            return
    # something bends too far for blocks, or the links themselves do: columns in memory
    width = gap.shape[1]
    columns = [model.linear_form(data.q, data.loads).regressor[:, :width], gap[..., None]]
    if nuisances:
        columns.insert(0, nuisance_columns(model, model.predict(data.q, data.loads), width))
    stored = np.concatenate(columns, axis=2) * cells[..., None]
    fold_rows(R, stored.reshape(-1, len(R)))


def fold_rows(R: Array, *parts: Array) -> None:
    """Fold further rows, or R factors of them, into R (k, k)."""
    folded = np.linalg.qr(np.vstack([R, *parts]), mode="r")
    R[:] = 0.0
    R[: len(folded)] = folded


def r_factor(rows: Array) -> Array:
    """Return the R factor of rows (M, k), a few thousand of them at a time."""
    R = rows[:0]
    for begin in range(0, len(rows), AT_ONCE):
        R = np.asarray(np.linalg.qr(np.vstack([R, rows[begin : begin + AT_ONCE]]), mode="r"))
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
            own = shifted(model, shift)
            columns[rows] = own.linear_form(data.q[rows], data.loads[rows]).regressor
    return columns


def stepped(
    now: Fit,
    problem: tuple[Array, Array, Array],
    weights: Array,
    kept: Mask,
    prior: tuple[Array, float],
) -> Fit:
    """Return the fit after one step of Gauss and Newton.

    ``problem``: columns of the nuisances (M, 0 or 9), of the flexibilities (M, 2n), and the gap
    (M,), all weighed; or their R factor's, which says the same in fewer rows.
    """
    F, A, b = problem
    model, frame, flexibility = now.model, now.frame, now.flexibility
    linear = _projected(A, b + A @ flexibility, basis_of(F, RANK))
    found = solve(linear, kept, flexibility, prior)
    if F.shape[1]:
        left = b - A @ (found - flexibility)
        step = least_squares.solve(F, left, rank=RANK)
        if now.geometry is not None:
            count = len(now.geometry.sigma)
            model, step = now.geometry.moved(model, step[:count]), step[count:]
        if len(step):
            model, frame = moved(model, frame, step)
    n = model.arm.n
    found_model = model.with_compliance(found[:n], found[n:])
    return Fit(found_model, frame, weights, linear, now.geometry)


def with_free_geometry(fit: Fit, data: Data) -> Fit:
    """Return the fit with the geometry as further nuisances, where the rows are likelier with it.

    The tool point is one of them where the cell's counts as known otherwise.
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
    whole = np.concatenate(columns, axis=2) * per_cell_of(weights, scale, width)[..., None]
    R = r_factor(whole.reshape(gap.size, -1))
    found = likelier(R, data.nuisances + 2 * n, width * float(weights.sum()), geometry)
    return fit if found is None else replace(fit, model=model, geometry=found)


def projected(fit: Fit, data: Data, geometry: Geometry | None) -> Linear:
    """Return the problem at a fit with its nuisances projected out, the geometry's where given."""
    R, n = _factor(fit, data, geometry)[0], fit.model.arm.n
    F, A, b = R[:, : -2 * n - 1], R[:, -2 * n - 1 : -1], R[:, -1]
    return _projected(A, b + A @ fit.flexibility, basis_of(F, RANK))


def tool_deviation(fit: Fit, data: Data) -> float:
    """Return the largest 1 sigma (m) of the tool point among all directions, frames beside it.

    Infinite where there is not one tool point that is estimated.
    """
    if data.tools != 1:
        return np.inf
    R = _factor(fit, data)[0]
    tool = 6 * data.frames + np.arange(3)
    own = projected_out(basis_of(R[:, : tool[0]], RANK), R[:, tool])
    return 1 / max(float(np.linalg.svd(own, compute_uv=False)[-1]), 1e-300)


def as_written(fit: Fit, data: Data) -> Fit:
    """Return the fit as the cell will have it: links as drawn, frames and tool points fitted to it.

    A tool point of a registered instrument is as it was, unless it alone is off.
    """
    if fit.geometry is None:
        return fit
    model = fit.geometry.written(fit.model)
    if not data.nuisances:
        return replace(fit, model=model, geometry=None)
    return replace(_placed(model, data, slice(None)), weights=fit.weights)


def _projected(A: Array, b: Array, Q: Array) -> Linear:
    """Return the problem off the nuisances ``Q``, brought to as few rows as it has unknowns."""
    whole = np.column_stack([A, b])
    R = np.asarray(np.linalg.qr(projected_out(Q, whole), mode="r"))
    return Linear(R[:, :-1], R[:, -1])


def solve(linear: Linear, kept: Mask, now: Array, prior: tuple[Array, float]) -> Array:
    """Return the flexibilities (2n,) that solve the problem; those not kept stay as they are.

    None is below zero; one at that bound is exactly zero.
    """
    centre, sigma = prior
    found, count = now.copy(), int(kept.sum())
    if not count:
        return found
    rows = np.vstack([linear.matrix[:, kept], np.eye(count) / sigma])
    right = np.concatenate(
        [linear.right - linear.matrix[:, ~kept] @ now[~kept], centre[kept] / sigma]
    )
    found[kept] = least_squares.bounded(rows, right, np.zeros(count), np.full(count, np.inf))[0]
    return found


def moved(
    model: Model, frame: Registration | Placements, step: NDArray[Any]
) -> tuple[Model, Registration | Placements]:
    """Return model and frames after a step of the nuisances: frame (6,), tool point (3,).

    Of several sessions: all frames, then one tool point, or one each where they were remounted.
    """
    if not isinstance(frame, Placements):
        return shifted(model, step[6:]), frame.moved(step[:6])
    count = len(frame.frames)
    tools = len(step) - 6 * count if len(step) >= 6 * count else len(step)
    turns, tool_steps = step[: len(step) - tools], step[len(step) - tools :].reshape(-1, 3)
    frames = frame.frames
    if len(turns):
        pieces = turns.reshape(count, 6)
        frames = tuple(f.moved(p) for f, p in zip(frames, pieces, strict=True))
    if len(tool_steps) == 1:
        return shifted(model, tool_steps[0]), replace(frame, frames=frames)
    shifts = tuple(a + b for a, b in zip(frame.tool_shift, tool_steps, strict=True))
    return model, Placements(frames, shifts)


def per_cell_of(weights: Array, scale: Array, width: int) -> Array:
    """Return the factor (N, width) that makes every cell's noise 1 and weighs its row."""
    return np.asarray(np.sqrt(weights)[:, None] / np.repeat(scale, 3)[:width])


def robust_weights(gap: Array) -> tuple[Array, Array]:
    """Return the weights (N,) of gaps (N, 3 or 6), and their noise (2,), m and rad."""
    scale = noise_of(gap)
    return weights_at(gap, scale), scale


def noise_of(gap: Array) -> Array:
    """Return the noise (2,), m and rad, of gaps (N, 3 or 6)."""
    return np.array([scale_of(gap[:, :3]), scale_of(gap[:, 3:]) if gap.shape[1] > 3 else 1.0])


def weights_at(gap: Array, scale: Array) -> Array:
    """Return the weights (N,) of gaps (N, 3 or 6) where the noise is ``scale`` (2,)."""
    return weights_of(distance_of(gap, np.repeat(scale, 3)[: gap.shape[1]]))
