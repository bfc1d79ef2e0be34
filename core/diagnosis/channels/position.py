"""The position channel: measured TCP poses against predicted ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from core.diagnosis.channels.observation import NotObservable, Observation, Predict
from core.diagnosis.selection.unnamed import unnamed_rivals
from core.effects import Term
from core.estimation.identification import pose_groups
from core.estimation.registration import IDENTITY, Registration, frame_columns, register_robustly
from core.loads import Loads
from core.log.log import Log
from core.metrology import Metrology
from core.model import Model
from core.rotation import rotation_matrix, rotation_vector

Array = NDArray[np.float64]
LEVER = 0.2  # m/rad: first weight of a rotation against a position
VARIES = 1e-9  # spread below which a quantity counts as constant


def observe(
    model: Model, log: Log, metrology: Metrology, frame: Registration | None = None
) -> Observation | NotObservable:
    """Return the position channel of a log, or what it lacks.

    Rows whose measured position is not finite are left out. Without a registered instrument its
    frame is estimated (robustly) and six nuisance columns keep it free; ``frame`` takes a better
    estimate. Raises LogError where joints, loads or temperatures hold something unusable.
    """
    measured = log.get("measured_position")
    if measured is None:
        return NotObservable("position", ("measured_position",))
    if not (log.has("actual_q") or log.has("target_q")):
        return NotObservable("position", ("actual_q",))
    q = log.require("actual_q", "target_q")
    turned = log.get("measured_rotation")
    whole_pose = measured if turned is None else np.hstack([measured, turned])
    rows = np.flatnonzero(np.isfinite(whole_pose).all(axis=1))
    if not len(rows):
        return NotObservable("position", ("measured_position",))
    q, measured, loads = q[rows], measured[rows], log.loads()[rows]
    rotation = None if turned is None else rotation_matrix(turned[rows])
    poses = model.predict(q, loads)
    if frame is None:
        frame = IDENTITY if metrology.registered else register_robustly(measured, poses.position)
    in_base = frame.in_base(measured)
    reference = None if rotation is None else frame.rotation_in_base(rotation)

    k = 3 if reference is None else 6
    value = in_base if reference is None else np.hstack([in_base, np.zeros((len(rows), 3))])
    nuisance = np.zeros((len(rows), k, 0))
    if not metrology.registered:
        nuisance = -frame_columns(in_base)[:, :k]
    form = model.linear_form(q, loads)
    placed = frame

    def rebase(step: Array) -> Observation:
        moved = observe(model, log, metrology, placed.moved(step))
        assert isinstance(moved, Observation)
        return moved

    whole = metrology.repeatability is not None
    return Observation(
        channel="position",
        unit="m",
        measured=value,
        predict=_prediction(model, q, loads, reference),
        nuisance=nuisance,
        weight=np.repeat([1.0, LEVER], 3)[:k],
        sigma=float(np.hypot(metrology.sigma, metrology.repeatability or 0.0)),
        sigma_is_whole=whole,
        quantities=quantities(log, rows) | approaches(loads.approach),
        groups=pose_groups(q) if len(q) <= 3000 else np.arange(len(q)),
        rows=rows,
        axes=("x", "y", "z", "rx", "ry", "rz")[:k],
        joint_columns=form.jacobian[:, :k],
        axial_moment=np.einsum("nij,nji->ni", form.moment, form.jacobian[:, 3:]),
        unnamed=lambda: unnamed_rivals(model, q, loads, k),
        tool_axes=poses.rotation,
        rebase=None if metrology.registered else rebase,
    )


def _prediction(model: Model, q: Array, loads: Loads, reference: Array | None) -> Predict:
    """Return terms -> positions (N, 3), with rotations as vectors off ``reference`` (N, 6)."""

    def predict(terms: Sequence[Term]) -> Array:
        real = model.with_terms(terms).predict(q, loads)
        if reference is None:
            return real.position
        # rotations as small vectors against the measured ones, so that gaps simply subtract
        off = rotation_vector(real.rotation @ np.swapaxes(reference, 1, 2))
        return np.hstack([real.position, off])

    return predict


def quantities(log: Log, rows: NDArray[np.int64]) -> dict[str, Array]:
    """Return every scalar column of the log that varies over ``rows``, by its name in the log."""
    found: dict[str, Array] = {}
    q = "actual_q" if log.has("actual_q") else "target_q"
    for name in ("timestamp", q, "payload", "payload_cog", "joint_temperatures",
                 "actual_TCP_force", "measured_position"):  # fmt: skip
        column = log.get(name)
        if column is None:
            continue
        values = column[rows].reshape(len(rows), -1)
        for i in range(values.shape[1]):
            if np.isfinite(values[:, i]).all() and np.ptp(values[:, i]) > VARIES:
                found[name if column.ndim == 1 else f"{name}_{i}"] = values[:, i]
    return found


def approaches(approach: Array | None) -> dict[str, Array]:
    """Return the joints' last motions as quantities, where both directions occur often enough."""
    if approach is None:
        return {}
    both = (np.sum(approach > 0, axis=0) >= 4) & (np.sum(approach < 0, axis=0) >= 4)
    return {f"approach_{i}": approach[:, i] for i in np.flatnonzero(both)}
