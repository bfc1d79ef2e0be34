"""Identification of the joint flexibilities of an arm from poses and loads.

Least squares on the paper's linear form (compliance_fit.py); instrument frame and tool point are
estimated if not registered. Flexibilities that are not identifiable keep the model's value and are
reported (base_parameters.py).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.effects import flexibility_names
from gapbridge.core.errors import ExcitationError, LogError
from gapbridge.core.estimation import base_parameters
from gapbridge.core.estimation.compliance_fit import (
    CONVERGED,
    RANK,
    Data,
    Fit,
    Placements,
    as_cell_model,
    fit_flexibilities,
    fit_nuisances,
    gap_after_registration,
    residual,
    tool_std,
    weighted_factor,
    with_free_geometry,
)
from gapbridge.core.estimation.flexibilities import prior_of
from gapbridge.core.estimation.geometry import TOOL_STD, Geometry
from gapbridge.core.estimation.held_out import FOLDS, joint_regions, random_folds
from gapbridge.core.estimation.least_squares import basis_of, projected_out
from gapbridge.core.estimation.pose_scatter import POSE_PARTS, error_groups, with_pose_scatter
from gapbridge.core.estimation.registration import IDENTITY, Registration
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.motion import time_stretches
from gapbridge.core.notes import Note, Reason
from gapbridge.core.rotation import rotation_matrix
from gapbridge.core.sessions import session_of

MAX_TOOL_STD = 2e-4  # m, 1 sigma of a tool point that is written to the cell
MAX_TOOL_SHIFT = 3 * TOOL_STD  # m from the cell's; farther off it is another point of the tool
REFIT_CONVERGED = 1e-4  # relative step, in cross-validation
REFIT_FRAME_CONVERGED = 1e-6  # m, rad, in cross-validation
FIRST_ROUNDS = 3  # of the fit of all flexibilities, before the choice
ROUNDING = 1e-9  # m
NOT_AVAILABLE = float("nan")


@dataclass(frozen=True)
class Identification:
    """Estimated flexibilities, their uncertainty and validation.

    All rms are of one coordinate over the same rows, without outliers. Frame and tool point are
    fitted before as well as after; the degrees of freedom are counted for both.
    """

    model: Model  # with the flexibilities, and the tool point that ``tool_offset`` moves
    axial: Array  # (n,) rad/Nm
    radial: Array  # (n,) rad/Nm
    std_axial: Array  # (n,) rad/Nm, 1 sigma; the prior's where not identifiable
    std_radial: Array  # (n,) rad/Nm, 1 sigma; the prior's where not identifiable
    covariance: Array  # (2n, 2n), axial then radial, of those shown with the others held
    identifiable: Mask  # (2n,); the others keep the model's value
    combinations: tuple[Note, ...]  # what the data do not separate or determine
    registration: Registration | Placements  # one frame, or one a session
    tool_offset: Array  # (3,) m, flange axes: found tool point minus the cell's; 0 if registered
    samples: int
    gap_rms: float  # m, before
    remaining_rms: float  # m, after
    gap_rms_held_out: float  # m, before, on poses that the fit did not see; nan: too few poses
    remaining_rms_held_out: float  # m, after, on the same poses
    outliers: NDArray[np.int64]  # rows down-weighted as outliers
    notes: tuple[Note, ...]
    remaining_rms_new_region: float = NOT_AVAILABLE  # m, folds are regions of joint space
    remaining_rms_new_session: float = NOT_AVAILABLE  # m, folds are sessions
    tool_determined: bool = True  # the tool point is accurate enough to be written to the cell

    @property
    def cell_model(self) -> Model:
        """Return the model for the cell, with the nominal tool point if it is not determined."""
        if self.tool_determined:
            return self.model
        tool = self.model.tool_in_flange.copy()
        tool[:3, 3] -= self.tool_offset
        return replace(self.model, tool_in_flange=tool)


@dataclass(frozen=True)
class _FitSettings:
    """The prior of the flexibilities and the convergence limits of a fit."""

    prior: tuple[Array, float]  # (2n,) rad/Nm, 1 sigma rad/Nm
    converged: float = CONVERGED  # relative step
    rounds: int = FIRST_ROUNDS  # of the fit of all flexibilities

    def run(self, before: Fit, data: Data) -> tuple[Fit, base_parameters.Identifiable]:
        """Fit all flexibilities, choose the identifiable ones, fit those."""
        centre = self.prior[0]
        all_free = np.ones(len(centre), dtype=bool)
        first = fit_flexibilities(before, data, all_free, self.prior, self.rounds, self.converged)
        assert first.linear is not None
        noise = self._noise(first, data, all_free)
        kept = base_parameters.choose_identifiable(first.linear, self.prior, noise)
        values, n = np.where(kept, first.flexibility, centre), len(centre) // 2
        begin = replace(first, model=first.model.with_compliance(values[:n], values[n:]))
        fit = fit_flexibilities(begin, data, kept, self.prior, converged=self.converged)
        assert fit.linear is not None
        noise = self._noise(fit, data, kept)
        return fit, base_parameters.identifiability_of(fit.linear, kept, self.prior[1], noise)

    def _noise(self, fit: Fit, data: Data, kept: Mask) -> float:
        """Return the noise of a fit's residual over the robust one."""
        assert fit.linear is not None
        width = 3 if data.rotation is None else 6
        spare = width * float(fit.weights.sum()) - data.nuisances
        return base_parameters.residual_noise(
            fit.linear, fit.flexibility, kept, self.prior[1], spare
        )


def identify_compliance(
    model: Model, log: Log, metrology: Metrology | None = None
) -> Identification:
    """Return the 2n joint flexibilities that best explain the measured TCP poses of ``log``.

    The prior of each is the model's value, with a sigma of ten usual flexibilities for this size of
    arm; one that is not identifiable keeps that value. All are 0 or more. If the metrology is not
    registered, frame and tool point are estimated; so are links and joint zeros if that is more
    likely, unless a cell without them would predict held-out poses worse than ``model``. Raises
    LogError where needed columns are missing, ExcitationError where no load excites the compliance.
    """
    metrology = metrology or Metrology()
    data, used = data_of(log, metrology)
    prior = prior_of(model)
    require_excitation(model, data, metrology, prior[1])
    settings = _FitSettings(prior)
    before = fit_nuisances(model, data)
    # refits without some rows start at the fit to all
    refit = replace(settings, converged=REFIT_CONVERGED, rounds=1)
    fit, shown = settings.run(before, data)
    held_out, links_held = (NOT_AVAILABLE, NOT_AVAILABLE), False
    with_links = with_free_geometry(fit, data)
    if with_links.geometry is not None:
        fit_with_links, shown_with_links = settings.run(with_links, data)
        held_out = _held_out_rms(data, refit, (before, fit_with_links), fit_with_links.weights > 0)
        links_held = held_out[1] > held_out[0]  # the cell would predict worse without them
        if not links_held:
            fit, shown = fit_with_links, shown_with_links
    shown = with_pose_scatter(fit, data, shown, prior[1])
    inlier = fit.weights > 0
    if fit.geometry is None:
        held_out = _held_out_rms(data, refit, (before, fit), inlier)
    result = _result(model, data, used, (before, fit), shown, held_out, links_held)
    return replace(
        result,
        remaining_rms_new_region=_new_region_rms(data, refit, fit, inlier),
        remaining_rms_new_session=_new_session_rms(data, refit, fit, inlier),
    )


def measured_rows(
    log: Log, registered: bool, motions: bool = True
) -> tuple[Data, NDArray[np.int64]]:
    """Return the rows of a log with measured poses, as one session, and their numbers."""
    q = log.require("actual_q", "target_q")
    measured = log.get("measured_position")
    if measured is None:
        measured = log.require("measured_position")
    rotation = log.get("measured_rotation")
    finite = np.isfinite(measured).all(axis=1)
    if rotation is not None:
        finite &= np.isfinite(rotation).all(axis=1)
    used = np.flatnonzero(finite)
    matrix = None if rotation is None else rotation_matrix(rotation[used])
    stretch = time_stretches(log, POSE_PARTS)
    return Data(
        q[used], log.loads(motions)[used], measured[used], matrix, registered,
        stretch=None if stretch is None else stretch[used],
    ), used  # fmt: skip


def data_of(log: Log, metrology: Metrology, motions: bool = True) -> tuple[Data, NDArray[np.int64]]:
    """Return the rows of a log with measured poses, and their numbers.

    ``motions`` False: without the joints' last motions.
    """
    data, used = measured_rows(log, metrology.registered, motions)
    count = max(len(log.session_names), 1)
    if count > 1 or metrology.remounted:
        session = session_of(log)[used]
        _check_sessions(log, session, metrology)
        data = replace(data, session=session, sessions=count, remounted=metrology.remounted)
    return data, used


def _check_sessions(log: Log, session: NDArray[np.int64], metrology: Metrology) -> None:
    """Raise LogError where a session has too few poses for its nuisances."""
    free = (0 if metrology.registered else 6) + (3 if metrology.remounted else 0)
    for s, name in enumerate(log.session_names):
        count = int((session == s).sum())
        if 3 * count < free + 3:
            raise LogError(
                f"{log.path}: session {name}: found {count} measured pose(s), expected at least "
                f"{-(-(free + 3) // 3)}: its frame{' and tool point' if free > 6 else ''} are "
                "fitted on them"
            )


def require_excitation(model: Model, data: Data, metrology: Metrology, usual: float) -> None:
    """Raise ExcitationError where no joint of flexibility ``usual`` (rad/Nm) deflects visibly."""
    n = model.arm.n
    unknown = 2 + data.nuisances
    distinct = _distinct(data, unknown + 2 * n)
    found = f"found {len(data.q)} row(s) with measured positions"
    if distinct < len(data.q):
        found += f" of {distinct} different pose(s) and load(s)"
    if 3 * distinct < unknown:
        raise ExcitationError(
            f"{found}, expected at least {-(-unknown // 3)} to fit the compliance"
        )
    if data.frames and data.rotation is None:
        _require_frames(model, data, metrology)
    zeros, ones = np.zeros((len(data.q), 3)), np.ones((len(data.q), 3))
    R = weighted_factor(model, IDENTITY, replace(data, rotation=None), (zeros, ones))[:, :-1]
    form = projected_out(basis_of(R[:, : -2 * n], RANK), R[:, -2 * n :])
    shown = np.linalg.norm(form, axis=0) * usual
    if not (shown > 3 * metrology.sigma).any():
        weightless = not model.arm.mass.any() and data.loads.wrench is None
        reason = (
            "the arm's links have no mass in the cell, and no payload or pull is in the log"
            if weightless and not _any_payload(model, data)
            else "no payload, pull or pose in it changes a joint's moment enough to bend it visibly"
        )
        raise ExcitationError(
            f"nothing in the log excites the compliance: {reason}; expected poses under different "
            "payloads (payload) or pulls (actual_TCP_force)"
        )
    if 3 * distinct - data.nuisances <= 2 * n:
        size = np.linalg.svd(form, compute_uv=False) * usual
        determined = int((size > 3 * metrology.sigma).sum())
        if 3 * distinct - data.nuisances <= determined:
            raise ExcitationError(
                f"{found} for {determined} flexibilities that they bend: nothing is left by which "
                "a fit could be judged; expected more poses"
            )


def _require_frames(model: Model, data: Data, metrology: Metrology) -> None:
    """Raise ExcitationError where a session's positions lie on a line: its frame may turn about it.

    The poses may bear different loads: deflections do not determine a frame.
    """
    position = model.rigid_pose(data.q).position
    session = np.zeros(len(data.q)) if data.session is None else data.session
    for s in np.unique(session):
        own = position[session == s]
        across = np.linalg.svd(own - own.mean(axis=0), compute_uv=False)[1:2].sum()
        if across <= max(3 * metrology.sigma, ROUNDING):
            poses = len(np.unique(np.round(data.q[session == s], 3), axis=0))
            of_session = f" in session {int(s) + 1}" if data.sessions > 1 else ""
            raise ExcitationError(
                f"found measured positions of {poses} different pose(s) on one line{of_session}, "
                "expected at least three poses not on a line to fit the instrument's frame, or "
                "metrology.registered: true in the cell where the instrument measures in base"
            )


def _distinct(data: Data, enough: int) -> int:
    """Return how many rows differ in joints or load; of a long log maybe a lower bound.

    Some rows of a long log are counted first, and the others only if fewer than ``enough`` differ.
    """
    loads = (data.loads.payload_mass, data.loads.payload_cog, data.loads.wrench)
    if not len(data.q):
        return 0
    columns = [values.reshape(len(data.q), -1) for values in loads if values is not None]
    table = np.column_stack([data.q, *columns])
    count = len(np.unique(table[:: max(len(table) // (4 * enough), 1)], axis=0))
    return count if count >= enough else len(np.unique(table, axis=0))


def _any_payload(model: Model, data: Data) -> bool:
    mass = data.loads.payload_mass
    return bool(model.payload_mass > 0 if mass is None else (mass > 0).any())


def _held_out_rms(
    data: Data, settings: _FitSettings, whole: tuple[Fit, Fit], inlier: Mask
) -> tuple[float, float]:
    """Return the rms before and after over inlier rows of poses left out; nan: too few poses."""
    groups = error_groups(data)
    if int(groups.max()) + 1 < 2 * FOLDS:
        return NOT_AVAILABLE, NOT_AVAILABLE
    fold = random_folds(groups)
    gaps: tuple[list[Array], list[Array]] = ([], [])
    for k in range(FOLDS):
        fitted, judged = data.part(fold != k), data.part((fold == k) & inlier)
        if not len(judged.q):
            continue
        before = fit_nuisances(whole[0].model, fitted, whole[0].frame, REFIT_FRAME_CONVERGED)
        after = as_cell_model(settings.run(whole[1], fitted)[0], fitted)
        for fit, of_fit in zip((before, after), gaps, strict=True):
            of_fit.append(residual(fit.model, judged, fit.frame)[0][:, :3])
    return _rms(np.vstack(gaps[0])), _rms(np.vstack(gaps[1]))


def _new_region_rms(data: Data, settings: _FitSettings, whole: Fit, inlier: Mask) -> float:
    """Return the rms over inlier rows of regions of joint space left out; nan: too few poses."""
    if len(np.unique(np.round(data.q, 3), axis=0)) < 2 * FOLDS:
        return NOT_AVAILABLE
    fold, gaps = joint_regions(data.q, FOLDS), []
    for k in range(int(fold.max()) + 1):
        fitted, judged = data.part(fold != k), (fold == k) & inlier
        if data.session is not None and fitted.session is not None:
            judged &= np.isin(data.session, _placed_sessions(fitted))
        if not judged.any() or 3 * len(fitted.q) <= data.nuisances + 2:
            continue
        fit = as_cell_model(settings.run(whole, fitted)[0], fitted)
        gaps.append(residual(fit.model, data.part(judged), fit.frame)[0][:, :3])
    return _rms(np.vstack(gaps)) if len(gaps) > 1 else NOT_AVAILABLE


def _placed_sessions(data: Data) -> list[int]:
    """Return the sessions with enough poses to fit a frame and a tool point."""
    assert data.session is not None
    return [s for s in range(data.sessions) if 3 * int((data.session == s).sum()) >= 12]


def _new_session_rms(data: Data, settings: _FitSettings, whole: Fit, inlier: Mask) -> float:
    """Return the rms over inlier rows of sessions left out, each registered on itself; nan: one."""
    if data.session is None or data.sessions < 2:
        return NOT_AVAILABLE
    gaps = []
    for s in range(data.sessions):
        rest, judged = data.session != s, (data.session == s) & inlier
        if not (rest.any() and judged.any()):
            continue
        fitted = data.part(rest)
        fit = as_cell_model(settings.run(whole, fitted)[0], fitted)
        gaps.append(gap_after_registration(fit.model, data.part(judged))[:, :3])
    return _rms(np.vstack(gaps)) if gaps else NOT_AVAILABLE


def _rms(gap: Array, spent: int = 0) -> float:
    """Return the rms of one coordinate of (N, 3) for ``spent`` fitted numbers."""
    return float(np.sqrt(np.sum(gap**2) / max(gap.size - spent, 1)))


def _result(
    model: Model, data: Data, used: NDArray[np.int64], fits: tuple[Fit, Fit],
    shown: base_parameters.Identifiable, held_out: tuple[float, float], links_held: bool,
) -> Identification:  # fmt: skip
    n, kept = model.arm.n, shown.kept
    inlier = fits[1].weights > 0
    after = as_cell_model(fits[1], data)
    gaps = [residual(fit.model, data, fit.frame)[0][inlier][:, :3] for fit in (fits[0], after)]
    std, flexibility = np.sqrt(np.diag(shown.covariance)), after.flexibility
    known, count = tool_determined(after, data, model), int((~inlier).sum())
    return Identification(
        after.model, flexibility[:n], flexibility[n:], std[:n], std[n:], shown.covariance, kept,
        shown.notes, after.frame,
        after.model.tool_in_flange[:3, 3] - model.tool_in_flange[:3, 3], len(data.q),
        _rms(gaps[0], data.nuisances), _rms(gaps[1], data.nuisances + int(kept.sum())),
        *held_out, used[~inlier],
        tuple(notes_of(after, kept, count, data.nuisances, known, fits[1].geometry, links_held)),
        tool_determined=known,
    )  # fmt: skip


def tool_determined(fit: Fit, data: Data, nominal: Model) -> bool:
    """Return whether the tool point is written: one for all sessions, accurate, near the nominal.

    One that is too far off is a target at another point of the tool.
    """
    shift = fit.model.tool_in_flange[:3, 3] - nominal.tool_in_flange[:3, 3]
    if np.linalg.norm(shift) > MAX_TOOL_SHIFT:
        return False
    return data.tools == 0 or tool_std(fit, data) < MAX_TOOL_STD


def notes_of(
    fit: Fit, kept: Mask, outlier: int, nuisances: int, tool: bool, geometry: Geometry | None,
    links_held: bool,
) -> list[Note]:  # fmt: skip
    """Return the notes of a fit: outliers, bounds reached, frames, tool point, links.

    ``tool``: the tool point is written; ``links_held``: links are off, but were kept nominal.
    """
    notes = []
    if outlier:
        notes.append(Note(Reason.OUTLIERS, (outlier,)))
    at_zero = np.flatnonzero((fit.flexibility <= 0) & kept)
    if len(at_zero):
        every = flexibility_names(len(kept) // 2)
        names = tuple(every[i] for i in at_zero)
        notes.append(Note(Reason.AT_ZERO, (names,)))
    if not kept.any():
        notes.append(Note(Reason.NO_FLEXIBILITY))
    if isinstance(fit.frame, Placements) and len(fit.frame.frames) > 1:
        notes.append(Note(Reason.SESSION_FRAMES))
    elif nuisances:
        notes.append(Note(Reason.TOOL_WRITTEN if tool else Reason.NOTHING_WRITTEN))
    if links_held:
        notes.append(Note(Reason.LINKS_HELD))
    elif geometry is not None and geometry.has_links:
        notes.append(Note(Reason.LINKS_ESTIMATED))
    elif geometry is not None:
        notes.append(Note(Reason.TOOL_OFF_WRITTEN if tool else Reason.TOOL_OFF))
    return notes
