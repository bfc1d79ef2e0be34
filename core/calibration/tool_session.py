"""Tool session: the tool centre point from joint angles, without an instrument.

The tip touches one fixed point in several orientations. Flange poses follow from joint angles and
model; tool and point are fitted to them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.result import Estimate
from gapbridge.core.effects import correcting
from gapbridge.core.errors import ExcitationError, InputError
from gapbridge.core.estimation.robust import RobustFit, robust_fit
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason

NAMES = tuple(f"tool_tcp_{k}" for k in "xyz")
MIN_READINGS = 3
MIN_ROTATION = 0.15  # rad, about: spread of orientations that determines the tool
MAX_NOISE = 5e-3  # m, 1 sigma of one coordinate of a touch
ROUNDS = 30
CONVERGED = 1e-10  # m


@dataclass(frozen=True)
class ToolCalibration:
    """Result of a tool session."""

    tcp: Array  # (3,) m, flange axes
    point: Array  # (3,) m, base: the fixed point
    estimates: tuple[Estimate, ...]  # tool_tcp_x, _y, _z
    noise: float  # m, 1 sigma of one coordinate of one touch: operator, arm and model error
    residual: Array  # (N,) m, distance of each touch from the fixed point
    nominal_residual: Array  # (N,) m, the same with the cell's tool, point fitted
    outliers: NDArray[np.int64]  # touches down-weighted as outliers
    notes: tuple[Note, ...]
    moved: float  # m, from the cell's tool

    def applied(self, model: Model) -> Model:
        """Return the model with this tool centre point; the tool's axes stay as they are."""
        kept = tuple(t for t in model.terms if t.effect not in correcting("tool"))
        tool = model.tool_in_flange.copy()
        tool[:3, :3] = model.chain().tool_rotation
        tool[:3, 3] = self.tcp
        return replace(model, tool_in_flange=tool, terms=kept)


def calibrate_tool(model: Model, q: Array, loads: Loads | None = None) -> ToolCalibration:
    """Return the tool centre point from joint angles ``q`` (N, n), rad, of the touches.

    Outliers are down-weighted and listed. Raises InputError where the angles do not fit the arm, or
    the touches are not of one point, ExcitationError where the orientations do not determine the
    tool.
    """
    q = np.asarray(q, dtype=float)
    _check_shapes(model, q)
    position, rotation = flange_poses(model, q, loads)
    nominal = model.chain().tool_position
    point = np.asarray(np.median(position + rotation @ nominal, axis=0))  # of the tips, in base
    before = np.concatenate([nominal, point])
    values, fit = _fit_tip(position, rotation, before)
    if fit.noise[0] > MAX_NOISE:
        raise InputError(
            f"tool session: found touches {1e3 * fit.noise[0]:.1f} mm (1 sigma of a coordinate) "
            f"from one common point, expected at most {1e3 * MAX_NOISE:g} mm: was the point moved, "
            "did the tip slip, are joints mistyped, or is the arm not calibrated?"
        )
    std = np.sqrt(np.diag(fit.covariance))[:3]
    estimates = tuple(
        Estimate(name, float(v), float(s), "m", freedom=fit.freedom)
        for name, v, s in zip(NAMES, values, std, strict=False)
    )
    outliers = tuple(int(r) + 1 for r in fit.outliers)
    return ToolCalibration(
        values[:3].copy(), values[3:].copy(), estimates,
        float(fit.noise[0]), _distances(position, rotation, values),
        _distances(position, rotation, before), fit.outliers,
        (Note(Reason.TOUCHES_DOWN, (outliers,)),) if outliers else (),
        float(np.linalg.norm(values[:3] - nominal)),
    )  # fmt: skip


def flange_poses(model: Model, q: Array, loads: Loads | None = None) -> tuple[Array, Array]:
    """Return position (N, 3), m, and rotation (N, 3, 3) of the deflected flange, in base."""
    chain = model.chain()
    poses = model.predict(q, loads)
    rotation = poses.rotation @ chain.tool_rotation.T
    return poses.position - rotation @ chain.tool_position, rotation


def touch_columns(rotation: Array) -> Array:
    """Return d (tip - point) / d (tcp, point) as (N, 3, 6), for flange rotations (N, 3, 3)."""
    fixed = np.broadcast_to(-np.eye(3), rotation.shape)
    return np.concatenate([rotation, fixed], axis=2)


def _check_shapes(model: Model, q: Array) -> None:
    if q.ndim != 2 or q.shape[1] != model.arm.n or not np.isfinite(q).all():
        raise InputError(
            f"tool session: found angles {q.shape}, expected finite ones of (N, {model.arm.n})"
        )
    if len(q) < MIN_READINGS:
        raise ExcitationError(
            f"tool session: found {len(q)} touch(es), expected {MIN_READINGS} or more orientations"
        )


def _fit_tip(position: Array, rotation: Array, values: Array) -> tuple[Array, RobustFit]:
    """Return tool and point (6,), and the converged robust fit."""
    count = len(position)
    A = touch_columns(rotation).reshape(-1, 6)
    row, unit = np.repeat(np.arange(count), 3), np.zeros(3 * count, dtype=np.int64)
    _require_rotation(A, count)
    fit: RobustFit | None = None
    for _ in range(ROUNDS):
        offset = position + rotation @ values[:3] - values[3:]
        fit = robust_fit(A, -offset.ravel(), unit, row)
        values = values + fit.values
        if np.abs(fit.values).max() < CONVERGED:
            break
    assert fit is not None
    return values, fit


def _require_rotation(A: Array, count: int) -> None:
    size = np.linalg.svd(A, compute_uv=False)
    if size[-1] < MIN_ROTATION * np.sqrt(count) / 4:
        raise ExcitationError(
            f"tool session: in {count} touches the tool hardly turns, or about one axis only, so "
            "that its tip is not found; expected orientations tens of degrees apart about two axes"
        )


def _distances(position: Array, rotation: Array, values: Array) -> Array:
    offset = position + rotation @ values[:3] - values[3:]
    return np.asarray(np.linalg.norm(offset, axis=1))
