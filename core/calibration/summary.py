"""Notes of a calibration: residual structure, correlated parameters, warnings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.converged_fit import FitState
from gapbridge.core.calibration.held_out_check import HeldOutCheck
from gapbridge.core.calibration.missing_effects import MissingEffect
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.problem import Problem
from gapbridge.core.calibration.result import Estimate
from gapbridge.core.calibration.staging import AT_ODDS
from gapbridge.core.diagnosis.channel_diagnosis import Verdict
from gapbridge.core.diagnosis.diagnosis import Diagnosis
from gapbridge.core.effects import names_part_of
from gapbridge.core.estimation.base_parameters import COLLINEAR, correlated_pairs
from gapbridge.core.notes import Note, Reason

MIN_SIGMAS = 3.0  # distance from zero, in its sigmas, of a supported effect
MEMBER = 0.35  # share of a combination from which a parameter is named in it


def combinations(
    parameters: Parameters, state: FitState, shown: NDArray[np.bool_]
) -> tuple[Note, ...]:
    """Return the parameters that these readings do not determine, or only in combination."""
    notes = []
    names = parameters.names
    std = np.sqrt(np.diag(state.covariance))
    correlation = state.covariance / np.outer(std, std)
    for i in np.flatnonzero(~shown):
        partners = [int(j) for j in np.argsort(-np.abs(correlation[i])) if j != i]
        best = partners[0] if partners else -1
        if best >= 0 and abs(correlation[i, best]) > COLLINEAR:
            known = Reason.ONLY_DIFFERENCE if correlation[i, best] > 0 else Reason.ONLY_SUM
            notes.append(Note(known, (names[i], names[best])))
        elif others := _correlated_group(correlation, int(i)):
            notes.append(Note(Reason.ONLY_TOGETHER, (names[i], tuple(names[j] for j in others))))
        else:
            notes.append(Note(Reason.HARDLY_SHOWN, (names[i],)))
    return (*notes, *correlated_pairs(state.covariance, shown, names))


def _correlated_group(correlation: Array, i: int) -> list[int]:
    """Return the parameters (three at most) that together are collinear with one, if any."""
    variance_inflation = float(np.linalg.pinv(correlation, rcond=1e-12, hermitian=True)[i, i])
    if variance_inflation * (1 - COLLINEAR**2) < 1:
        return []
    correlations = np.abs(correlation[i])
    return [int(j) for j in np.argsort(-correlations) if j != i and correlations[j] > MEMBER][:3]


def notes_of(
    problem: Problem, state: FitState, check: HeldOutCheck, hausman: float | None,
    estimates: tuple[Estimate, ...],
) -> tuple[Note, ...]:  # fmt: skip
    """Return the warnings of a fit."""
    notes = []
    if not state.converged:
        notes.append(Note(Reason.NOT_CONVERGED))
    bound = tuple(e.name for e in estimates if e.on_bound)
    if bound:
        notes.append(Note(Reason.ON_BOUND, (bound,)))
    outliers = int((~state.inliers).sum())
    if outliers:
        notes.append(Note(Reason.OUTLIERS, (outliers,)))
    if len(check.outliers):
        rows = tuple(int(r) + 1 for r in check.outliers)
        notes.append(Note(Reason.HELD_OUT_FAR, (rows,)))
    if hausman is not None and hausman < AT_ODDS:
        notes.append(Note(Reason.LOADS_AT_ODDS))
    if not problem.stages.possible and problem.stages.elastic.any():
        notes.append(Note(Reason.SAME_LOADS))
    return tuple(notes)


def remaining_of(
    check: HeldOutCheck, diagnosis: Diagnosis | None, complete: bool,
    missing: tuple[MissingEffect, ...], converged: bool,
) -> Note:  # fmt: skip
    """Return the note on the residual structure."""
    if complete:
        return Note(Reason.NOTHING)
    if not converged:
        return Note(Reason.UNCONVERGED)
    if missing:
        pairs = tuple((lack.name, lack.share) for lack in missing)
        return Note(Reason.EFFECTS_MISSING, (pairs,))
    channels = () if diagnosis is None else diagnosis.channels
    causes = sorted({cause.effect for c in channels for cause in c.causes})
    if causes:
        return Note(Reason.EFFECTS_ACCUSED, (tuple(causes),))
    if diagnosis is not None and diagnosis.verdict is not Verdict.NO_GAP:
        return Note(Reason.STRUCTURE)
    return Note(Reason.FAR_OFF, (float(np.sqrt(check.ratio)),))


def unsupported(estimates: tuple[Estimate, ...], names: tuple[str, ...]) -> tuple[str, ...]:
    """Return those of the effects ``names`` that a fit does not support.

    An effect is supported if one of its values is more than three sigmas from zero and off its
    bounds.
    """
    return tuple(
        name
        for name in names
        if not any(
            abs(e.value) > MIN_SIGMAS * e.std and e.shown and not e.on_bound
            for e in estimates
            if names_part_of(e.name, name)
        )
    )
