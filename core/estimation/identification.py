"""Identification: the joint flexibilities of an arm, from poses and loads.

Least squares on the paper's linear form (compliance_fit.py), with the instrument's frame and the
tool point estimated along where nobody registered them. Rank is handled by a choice instead of by
luck: what the data do not show stays at the model's value and is named (base_parameters.py).
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
    as_written,
    fit_flexibilities,
    fit_nuisances,
    placed_gap,
    prior_of,
    residual,
    tool_deviation,
    weighed,
    with_free_geometry,
)
from gapbridge.core.estimation.geometry import TOOL, Geometry
from gapbridge.core.estimation.held_out import FOLDS, joint_regions, pose_groups, random_folds
from gapbridge.core.estimation.least_squares import basis_of, projected_out
from gapbridge.core.estimation.pose_scatter import by_poses
from gapbridge.core.estimation.registration import IDENTITY, Registration
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason
from gapbridge.core.rotation import rotation_matrix
from gapbridge.core.sessions import session_of

TOOL_KNOWN = 2e-4  # m, 1 sigma: a tool point that is known worse stays the cell's
TOOL_NEAR = (
    3 * TOOL
)  # m from the cell's: a point farther off is none that somebody took for the TCP
NEAR = 1e-4  # relative step at which a fit has converged that is only judged by
NEAR_FRAME = 1e-6  # m, rad: step at which a frame has converged that is only judged by
LOOK = 3  # rounds of the fit of everything, from which the choice is made
UNSEEN = float("nan")


@dataclass(frozen=True)
class Identification:
    """Flexibilities found, what they rest on and how far they carry.

    All four rms are of one coordinate over the same rows, outliers left out; frame and tool
    point are fitted before as well as after, and the degrees of freedom spent are counted for both.
    """

    model: Model  # with the flexibilities, and the tool point that ``tool_offset`` moves
    axial: Array  # (n,) rad/Nm
    radial: Array  # (n,) rad/Nm
    std_axial: Array  # (n,) rad/Nm, 1 sigma; the prior's where not identifiable
    std_radial: Array  # (n,) rad/Nm, 1 sigma; the prior's where not identifiable
    covariance: Array  # (2n, 2n), axial then radial, of those shown with the others held
    identifiable: Mask  # (2n,): shown by the data; the others stand at the model's value
    combinations: tuple[Note, ...]  # what the data cannot separate or do not show
    registration: Registration | Placements  # one frame, or one a session
    tool_offset: Array  # (3,) m, flange axes: found tool point minus the cell's; 0 if registered
    samples: int
    gap_rms: float  # m, before
    remaining_rms: float  # m, after
    gap_rms_held_out: float  # m, before, on poses that the fit did not see; nan: too few poses
    remaining_rms_held_out: float  # m, after, on the same poses
    outliers: NDArray[np.int64]  # rows down-weighted as outlier
    notes: tuple[Note, ...]
    remaining_rms_new_region: float = UNSEEN  # m, folds are regions of joint space
    remaining_rms_new_session: float = UNSEEN  # m, folds are sessions
    tool_known: bool = True  # the tool point found is good enough to be written

    @property
    def written(self) -> Model:
        """Return the model as a cell should hold it: with a tool point that the poses determine."""
        if self.tool_known:
            return self.model
        tool = self.model.tool_in_flange.copy()
        tool[:3, 3] -= self.tool_offset
        return replace(self.model, tool_in_flange=tool)


@dataclass(frozen=True)
class _Task:
    """How to fit: what the model says of the flexibilities, and how firmly."""

    prior: tuple[Array, float]  # (2n,) rad/Nm, 1 sigma rad/Nm
    converged: float = CONVERGED  # relative step
    look: int = LOOK  # rounds of the fit of everything

    def run(self, before: Fit, data: Data) -> tuple[Fit, base_parameters.Identifiable]:
        """Fit everything, choose what the data show, fit that alone."""
        centre = self.prior[0]
        everything = np.ones(len(centre), dtype=bool)
        look = fit_flexibilities(before, data, everything, self.prior, self.look, self.converged)
        assert look.linear is not None
        kept = base_parameters.choose(look.linear, self.prior)
        values, n = np.where(kept, look.flexibility, centre), len(centre) // 2
        begin = replace(look, model=look.model.with_compliance(values[:n], values[n:]))
        fit = fit_flexibilities(begin, data, kept, self.prior, converged=self.converged)
        assert fit.linear is not None
        return fit, base_parameters.what_is_shown(fit.linear, kept, self.prior[1])


def identify_compliance(
    model: Model, log: Log, metrology: Metrology | None = None
) -> Identification:
    """Return the 2n joint flexibilities that best explain the measured TCP poses of ``log``.

    Each is weakly held at the model's own value, by ten usual flexibilities of an arm of this size;
    one that the data do not know better stays there exactly. None is below zero. Where the
    metrology is not registered, frame and tool point are estimated along; so are links and joints'
    zeros where the poses are likelier with them, unless a cell without them would then predict
    unseen poses worse than ``model`` does. Raises LogError where
    needed columns are missing, ExcitationError where nothing in the log makes the joints bend.
    """
    metrology = metrology or Metrology()
    data, used = data_of(log, metrology)
    prior = prior_of(model)
    require_excitation(model, data, metrology, prior[1])
    task = _Task(prior)
    before = fit_nuisances(model, data)
    # fits that lack some rows begin at the fit to all
    rest = replace(task, converged=NEAR, look=1)
    fit, shown = task.run(before, data)
    held_out, held = (UNSEEN, UNSEEN), False
    beside = with_free_geometry(fit, data)
    if beside.geometry is not None:
        other, other_shown = task.run(beside, data)
        held_out = _held_out(data, rest, (before, other), other.weights > 0)
        held = held_out[1] > held_out[0]  # the cell would be worse without the links found
        if not held:
            fit, shown = other, other_shown
    shown = by_poses(fit, data, shown, prior[1])
    inlier = fit.weights > 0
    if fit.geometry is None:
        held_out = _held_out(data, rest, (before, fit), inlier)
    found = _result(model, data, used, (before, fit), shown, held_out, held)
    return replace(
        found,
        remaining_rms_new_region=_in_new_regions(data, rest, fit, inlier),
        remaining_rms_new_session=_in_new_sessions(data, rest, fit, inlier),
    )


def measured_rows(
    log: Log, registered: bool, motions: bool = True
) -> tuple[Data, NDArray[np.int64]]:
    """Return the rows of a log that have measured poses as those of one session, and which."""
    q = log.require("actual_q", "target_q")
    measured = log.get("measured_position")
    if measured is None:
        measured = log.require("measured_position")
    rotation = log.get("measured_rotation")
    good = np.isfinite(measured).all(axis=1)
    if rotation is not None:
        good &= np.isfinite(rotation).all(axis=1)
    used = np.flatnonzero(good)
    matrix = None if rotation is None else rotation_matrix(rotation[used])
    return Data(q[used], log.loads(motions)[used], measured[used], matrix, registered), used


def data_of(log: Log, metrology: Metrology, motions: bool = True) -> tuple[Data, NDArray[np.int64]]:
    """Return the rows of a log that have measured poses, and which ones they are.

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
    """Raise LogError where a session has too few poses for what is free in it."""
    free = (0 if metrology.registered else 6) + (3 if metrology.remounted else 0)
    for s, name in enumerate(log.session_names):
        found = int((session == s).sum())
        if 3 * found < free + 3:
            raise LogError(
                f"{log.path}: session {name}: found {found} measured pose(s), expected at least "
                f"{-(-(free + 3) // 3)}: its frame{' and tool point' if free > 6 else ''} are "
                "fitted on them"
            )


def require_excitation(model: Model, data: Data, metrology: Metrology, usual: float) -> None:
    """Raise ExcitationError where nothing in the data makes a joint bend by ``usual`` (rad/Nm)."""
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
    nothing, all_alike = np.zeros((len(data.q), 3)), np.ones((len(data.q), 3))
    R = weighed(model, IDENTITY, replace(data, rotation=None), (nothing, all_alike))[:, :-1]
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


def _distinct(data: Data, enough: int) -> int:
    """Return how many rows differ in joints or load: a reading that is repeated fits no more.

    Of a long log some rows are looked at first, and no others where ``enough`` differ.
    """
    loads = (data.loads.payload_mass, data.loads.payload_cog, data.loads.wrench)
    given = [values.reshape(len(data.q), -1) for values in loads if values is not None]
    table = np.column_stack([data.q, *given])
    found = len(np.unique(table[:: max(len(table) // (4 * enough), 1)], axis=0))
    return found if found >= enough else len(np.unique(table, axis=0))


def _any_payload(model: Model, data: Data) -> bool:
    mass = data.loads.payload_mass
    return bool(model.payload_mass > 0 if mass is None else (mass > 0).any())


def _held_out(data: Data, task: _Task, whole: tuple[Fit, Fit], inlier: Mask) -> tuple[float, float]:
    """Return the rms before and after over inlier rows of poses left out; nan: too few poses."""
    groups = pose_groups(data.q[:2000]) if len(data.q) <= 2000 else np.arange(len(data.q))
    if int(groups.max()) + 1 < 2 * FOLDS:
        return UNSEEN, UNSEEN
    fold = random_folds(groups)
    left: tuple[list[Array], list[Array]] = ([], [])
    for k in range(FOLDS):
        seen, unseen = data.part(fold != k), data.part((fold == k) & inlier)
        if not len(unseen.q):
            continue
        before = fit_nuisances(whole[0].model, seen, whole[0].frame, NEAR_FRAME)
        after = as_written(task.run(whole[1], seen)[0], seen)
        for fit, gaps in zip((before, after), left, strict=True):
            gaps.append(residual(fit.model, unseen, fit.frame)[0][:, :3])
    return _rms(np.vstack(left[0])), _rms(np.vstack(left[1]))


def _in_new_regions(data: Data, task: _Task, whole: Fit, inlier: Mask) -> float:
    """Return the rms over inlier rows of regions of joint space left out; nan: too few poses."""
    if len(np.unique(np.round(data.q, 3), axis=0)) < 2 * FOLDS:
        return UNSEEN
    fold, left = joint_regions(data.q, FOLDS), []
    for k in range(int(fold.max()) + 1):
        seen, judged = data.part(fold != k), (fold == k) & inlier
        if data.session is not None and seen.session is not None:
            judged &= np.isin(data.session, _placed_sessions(seen))
        if not judged.any() or 3 * len(seen.q) <= data.nuisances + 2:
            continue
        fit = as_written(task.run(whole, seen)[0], seen)
        left.append(residual(fit.model, data.part(judged), fit.frame)[0][:, :3])
    return _rms(np.vstack(left)) if len(left) > 1 else UNSEEN


def _placed_sessions(data: Data) -> list[int]:
    """Return the sessions with enough poses for a frame and a tool point of their own."""
    assert data.session is not None
    return [s for s in range(data.sessions) if 3 * int((data.session == s).sum()) >= 12]


def _in_new_sessions(data: Data, task: _Task, whole: Fit, inlier: Mask) -> float:
    """Return the rms over inlier rows of sessions left out, each registered on itself; nan: one."""
    if data.session is None or data.sessions < 2:
        return UNSEEN
    left = []
    for s in range(data.sessions):
        rest, own = data.session != s, (data.session == s) & inlier
        if not (rest.any() and own.any()):
            continue
        others = data.part(rest)
        fit = as_written(task.run(whole, others)[0], others)
        left.append(placed_gap(fit.model, data.part(own))[:, :3])
    return _rms(np.vstack(left)) if left else UNSEEN


def _rms(gap: Array, spent: int = 0) -> float:
    """Return the rms of one coordinate of (N, 3) for ``spent`` fitted numbers."""
    return float(np.sqrt(np.sum(gap**2) / max(gap.size - spent, 1)))


def _result(
    model: Model, data: Data, used: NDArray[np.int64], fits: tuple[Fit, Fit],
    shown: base_parameters.Identifiable, held_out: tuple[float, float], held: bool,
) -> Identification:  # fmt: skip
    n, kept = model.arm.n, shown.kept
    inlier = fits[1].weights > 0
    after = as_written(fits[1], data)
    gaps = [residual(fit.model, data, fit.frame)[0][inlier][:, :3] for fit in (fits[0], after)]
    std, flexibility = np.sqrt(np.diag(shown.covariance)), after.flexibility
    known, count = tool_known(after, data, model), int((~inlier).sum())
    return Identification(
        after.model, flexibility[:n], flexibility[n:], std[:n], std[n:], shown.covariance, kept,
        shown.reported, after.frame,
        after.model.tool_in_flange[:3, 3] - model.tool_in_flange[:3, 3], len(data.q),
        _rms(gaps[0], data.nuisances), _rms(gaps[1], data.nuisances + int(kept.sum())),
        *held_out, used[~inlier],
        tuple(notes_of(after, kept, count, data.nuisances, known, fits[1].geometry, held)),
        tool_known=known,
    )  # fmt: skip


def tool_known(fit: Fit, data: Data, nominal: Model) -> bool:
    """Return whether the cell gets the tool point found: one for all sessions, sure, and a TCP's.

    What is farther off than a TCP may be is a target that sits elsewhere on the tool.
    """
    shift = fit.model.tool_in_flange[:3, 3] - nominal.tool_in_flange[:3, 3]
    if np.linalg.norm(shift) > TOOL_NEAR:
        return False
    return data.tools == 0 or tool_deviation(fit, data) < TOOL_KNOWN


def notes_of(
    fit: Fit, kept: Mask, outlier: int, nuisances: int, tool: bool, geometry: Geometry | None,
    held: bool,
) -> list[Note]:  # fmt: skip
    """Return what a fit was like: outliers, bounds reached, what was not identifiable.

    ``tool``: the tool point found is written; ``held``: links are off, and were held nominal.
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
    if held:
        notes.append(Note(Reason.LINKS_HELD))
    elif geometry is not None and geometry.has_links:
        notes.append(Note(Reason.LINKS_ESTIMATED))
    elif geometry is not None:
        notes.append(Note(Reason.TOOL_OFF_WRITTEN if tool else Reason.TOOL_OFF))
    return notes
