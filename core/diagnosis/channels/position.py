"""The position channel: measured TCP poses against predicted ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.derivatives import signal_noise
from gapbridge.core.diagnosis.channels.recording import STRETCHES, varying
from gapbridge.core.diagnosis.criteria import MIN_APPROACHES, MIN_FREEDOM_OF_SESSION
from gapbridge.core.diagnosis.observation import NotObservable, Observation, Predict, stacked
from gapbridge.core.diagnosis.selection.unnamed import unnamed_causes
from gapbridge.core.effects import Term
from gapbridge.core.errors import LogError
from gapbridge.core.estimation.compliance_fit import Data, fit_nuisances
from gapbridge.core.estimation.held_out import pose_groups
from gapbridge.core.estimation.registration import (
    IDENTITY,
    Registration,
    frame_columns,
    register_robustly,
)
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model, Poses
from gapbridge.core.motion import time_stretches
from gapbridge.core.rotation import rotation_matrix, rotation_vector
from gapbridge.core.sessions import session_of, sessions_in

PLACE = "measured_position"
MIN_PLACE = 0.02  # m: range of a coordinate of it that says where the arm is
LEVER = 0.2  # m/rad: initial weight of a rotation relative to a position


@dataclass(frozen=True)
class Placement:
    """Pose of the instrument's frame, and of the target on the flange, in one session."""

    frame: Registration
    tool_in_flange: Array  # (4, 4)

    def moved(self, step: Array) -> Placement:
        """Return the placement after a small step: frame (6,), then tool (0, 3 or 6,), flange."""
        tool = self.tool_in_flange.copy()
        if len(step) > 6:
            tool[:3, 3] += step[6:9]
        if len(step) > 9:
            tool[:3, :3] = rotation_matrix(step[9:12]) @ tool[:3, :3]
        return Placement(self.frame.moved(step[:6]), tool)


def observe(model: Model, log: Log, metrology: Metrology) -> Observation | NotObservable:
    """Return the position channel of a log, or what it lacks.

    Rows whose measured position is not finite are left out. Without a registered instrument the
    frame of each session is estimated (robustly) and six nuisance columns keep it free; where the
    target was remounted, three more (six with rotations) keep each session's tool point free.
    Where the measured rows are a recording of motion, stretches of time are held out as they are in
    the other channels of recordings: neighbours in time share their errors. Raises LogError where
    joints, loads or temperatures hold something unusable, or a session has too few poses for a
    frame of its own.
    """
    if log.get("measured_position") is None:
        return NotObservable("position", ("measured_position",))
    if not (log.has("actual_q") or log.has("target_q")):
        return NotObservable("position", ("actual_q",))
    index, parts = session_of(log), []
    for s, part in enumerate(sessions_in(log)):
        observation = _observe_session(model, part, metrology)
        if observation is None:
            continue
        _check_enough(observation, part, log.session_names[s] if log.session_names else "")
        own_rows = np.flatnonzero(index == s)[observation.rows]
        parts.append(_numbered(observation, s, own_rows))
    if not parts:
        return NotObservable("position", ("measured_position",))
    if len(log.session_names) < 2:
        return _in_motion(replace(parts[0], session=None), log)
    rows = np.concatenate([part.rows for part in parts])
    together = quantities(log, rows) | approaches(log.loads().approach, rows)
    for k in range(3):  # the sessions' frames differ: positions compare in base only
        together[f"{PLACE}_{k}"] = np.concatenate([p.measured[:, k] for p in parts])
    together = _without_plates(together)
    q = log.require("actual_q", "target_q")[rows]
    return _in_motion(stacked(parts, together, pose_groups(q)), log)


def _in_motion(observation: Observation, log: Log) -> Observation:
    """Return the observation as a recording where its rows of the log sample a motion."""
    stretch = time_stretches(log.select(observation.rows), STRETCHES)
    if stretch is None:
        return observation
    return replace(
        observation, groups=stretch, order_in_time=True,
        instrument=lambda: signal_noise(observation.measured - observation.predict(())),
    )  # fmt: skip


def _numbered(observation: Observation, session: int, rows: NDArray[np.int64]) -> Observation:
    """Return a session's observation with its number and its rows in the joined log."""
    rebase = observation.rebase

    def moved(step: Array, terms: Sequence[Term]) -> Observation:
        assert rebase is not None
        return _numbered(rebase(step, terms), session, rows)

    return replace(
        observation, rows=rows, session=np.full(len(rows), session),
        rebase=None if rebase is None else moved,
    )  # fmt: skip


def _check_enough(observation: Observation, log: Log, name: str) -> None:
    """Raise LogError where a session of several has too few poses for its nuisances."""
    N, k, p = observation.nuisance.shape
    least = p + MIN_FREEDOM_OF_SESSION
    if name and N * k < least:
        raise LogError(
            f"{log.path}: session {name}: found {N} measured pose(s), expected at least "
            f"{-(-least // k)}: its frame{' and tool point' if p > 6 else ''} are fitted on them"
        )


def _observe_session(model: Model, log: Log, metrology: Metrology) -> Observation | None:
    """Return the position channel of one session, or None where nothing was measured."""
    measured, turned = log.columns["measured_position"], log.get("measured_rotation")
    whole_pose = measured if turned is None else np.hstack([measured, turned])
    rows = np.flatnonzero(np.isfinite(whole_pose).all(axis=1))
    if not len(rows):
        return None
    rotation = None if turned is None else rotation_matrix(turned[rows])
    q, loads = log.require("actual_q", "target_q")[rows], log.loads()[rows]
    data = Data(q, loads, measured[rows], rotation, metrology.registered)
    return _observed(model, log, metrology, rows, data, _placed(model, data, metrology))


def _observed(
    model: Model, log: Log, metrology: Metrology, rows: NDArray[np.int64], data: Data,
    placement: Placement, terms: Sequence[Term] = (),
) -> Observation:  # fmt: skip
    """Return the position channel of one session at a placement, ``data`` those of its ``rows``.

    The tool point's columns are those of the model with ``terms``. Those of the nominal arm would
    have the error of its joint angles, and a rotation of a joint could appear as a cause.
    """
    q, loads, k = data.q, data.loads, 3 if data.rotation is None else 6
    model = replace(model, tool_in_flange=placement.tool_in_flange)
    poses = model.with_terms(terms).predict(q, loads)
    frame, in_base = placement.frame, placement.frame.in_base(data.position)
    reference = None if data.rotation is None else frame.rotation_in_base(data.rotation)
    nuisance = np.zeros((len(rows), k, 0))
    if not metrology.registered:
        nuisance = -frame_columns(in_base)[:, :k]
    if metrology.remounted:
        nuisance = np.concatenate([nuisance, _tool_columns(model, poses, k)], axis=2)
    form = model.linear_form(q, loads)

    def rebase(step: Array, terms: Sequence[Term]) -> Observation:
        whole = np.concatenate([np.zeros(6), step]) if metrology.registered else step
        return _observed(model, log, metrology, rows, data, placement.moved(whole), terms)

    return Observation(
        channel="position",
        unit="m",
        measured=in_base if k == 3 else np.hstack([in_base, np.zeros((len(rows), 3))]),
        predict=_prediction(model, q, loads, reference),
        nuisance=nuisance,
        weight=np.repeat([1.0, LEVER], 3)[:k],
        sigma=float(np.hypot(metrology.sigma, metrology.repeatability or 0.0)),
        sigma_is_whole=metrology.repeatability is not None,
        quantities=quantities(log, rows) | approaches(loads.approach),
        groups=pose_groups(q),
        rows=rows,
        axes=("x", "y", "z", "rx", "ry", "rz")[:k],
        joint_columns=form.jacobian[:, :k],
        axial_moment=np.einsum("nij,nji->ni", form.moment, form.jacobian[:, 3:]),
        unnamed=lambda: unnamed_causes(model, q, loads, k),
        tool_axes=poses.rotation,
        times=loads.time,
        payload_mass=loads.payload_mass,
        rebase=rebase if nuisance.shape[2] else None,
        free_frame=not metrology.registered,
    )


def session_model(model: Model, log: Log, metrology: Metrology) -> Model:
    """Return the model with the tool point of one session, where it was remounted."""
    if not metrology.remounted or metrology.registered or not log.has("measured_position"):
        return model
    q = log.require("actual_q", "target_q")
    measured = log.columns["measured_position"]
    rows = np.flatnonzero(np.isfinite(measured).all(axis=1))
    if 3 * len(rows) < 12:
        return model
    data = Data(q[rows], log.loads()[rows], measured[rows], None, registered=False)
    tool = _placed(model, data, metrology).tool_in_flange
    return replace(model, tool_in_flange=tool)


def _placed(model: Model, data: Data, metrology: Metrology) -> Placement:
    """Return a robust first estimate of a session's frame and tool point."""
    frame, tool = IDENTITY, model.tool_in_flange
    if not metrology.registered:
        frame = register_robustly(data.position, model.predict(data.q, data.loads).position)
    if metrology.remounted and not metrology.registered:
        fit = fit_nuisances(model, data)
        assert isinstance(fit.frame, Registration)
        frame, tool = fit.frame, fit.model.tool_in_flange
    return Placement(frame, tool)


def _tool_columns(model: Model, poses: Poses, k: int) -> Array:
    """Return d prediction / d tool point (N, k, 3), with rotations (N, 6, 6), flange axes."""
    flange = poses.rotation @ model.tool_in_flange[:3, :3].T
    columns = np.zeros((len(flange), k, k))
    columns[:, :3, :3] = flange
    if k == 6:
        columns[:, 3:, 3:] = flange
    return columns


def _prediction(model: Model, q: Array, loads: Loads, reference: Array | None) -> Predict:
    """Return terms -> positions (N, 3), with ``reference`` also rotation vectors to it (N, 6)."""

    def predict(terms: Sequence[Term]) -> Array:
        real = model.with_terms(terms).predict(q, loads)
        if reference is None:
            return real.position
        # rotation vectors relative to the measured ones, so that gaps are differences
        off = rotation_vector(real.rotation @ np.swapaxes(reference, 1, 2))
        return np.hstack([real.position, off])

    return predict


def quantities(log: Log, rows: NDArray[np.int64]) -> dict[str, Array]:
    """Return every scalar column of the log that varies over ``rows``, by its name in the log."""
    q = "actual_q" if log.has("actual_q") else "target_q"
    named_columns = ((name, log.get(name)) for name in (
        "timestamp", "session", q, "payload", "payload_cog", "joint_temperatures",
        "actual_TCP_force", PLACE,
    ))  # fmt: skip
    return _without_plates(
        varying({name: column[rows] for name, column in named_columns if column is not None})
    )


def _without_plates(quantities: dict[str, Array]) -> dict[str, Array]:
    """Return the quantities but coordinates of measured positions that hardly change.

    On a plate one changes by gap and noise alone, which would seem to depend on it.
    """
    return {
        name: values for name, values in quantities.items()
        if not name.startswith(PLACE) or np.ptp(values) > MIN_PLACE
    }  # fmt: skip


def approaches(approach: Array | None, rows: NDArray[np.int64] | None = None) -> dict[str, Array]:
    """Return the joints' last motions as quantities, where both directions occur often enough."""
    if approach is None:
        return {}
    approach = approach if rows is None else approach[rows]
    both = np.minimum((approach > 0).sum(axis=0), (approach < 0).sum(axis=0)) >= MIN_APPROACHES
    return {f"approach_{i}": approach[:, i] for i in np.flatnonzero(both)}
