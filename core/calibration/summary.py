"""A calibration in words: its verdict, what cannot be separated, what deserves a second look."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.calibration.converged_fit import ConvergedFit
from gapbridge.core.calibration.held_out_check import HeldOutCheck
from gapbridge.core.calibration.missing_effects import MissingEffect
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.problem import Problem
from gapbridge.core.calibration.result import Errors, Estimate
from gapbridge.core.calibration.staging import AT_ODDS
from gapbridge.core.diagnosis.diagnosis import Diagnosis

Array = NDArray[np.float64]
CLOSE = 0.98  # correlation from which two parameters count as one combination
SIGMAS = 3.0  # from zero, of its own, that a further effect must be to be fitted
MEMBER = 0.35  # share of a combination from which a parameter is named in it


def combinations(
    parameters: Parameters, rest: ConvergedFit, shown: NDArray[np.bool_]
) -> tuple[str, ...]:
    """Return what these readings do not determine, or only together."""
    notes = []
    names = parameters.names
    std = np.sqrt(np.diag(rest.covariance))
    correlation = rest.covariance / np.outer(std, std)
    for i in np.flatnonzero(~shown):
        partners = [int(j) for j in np.argsort(-np.abs(correlation[i])) if j != i]
        best = partners[0] if partners else -1
        if best >= 0 and abs(correlation[i, best]) > CLOSE:
            what = "difference" if correlation[i, best] > 0 else "sum"
            notes.append(f"{names[i]}: these readings determine only its {what} with {names[best]}")
        elif others := _company(correlation, int(i)):
            company = ", ".join(names[j] for j in others)
            notes.append(f"{names[i]}: these readings determine it only together with {company}")
        else:
            notes.append(f"{names[i]}: these readings hardly show it; it stays near its beginning")
    for i in np.flatnonzero(shown):
        for j in np.flatnonzero(shown):
            if j > i and abs(correlation[i, j]) > CLOSE:
                what = "difference" if correlation[i, j] > 0 else "sum"
                notes.append(
                    f"{names[i]} and {names[j]}: mostly their {what} is known "
                    f"(correlation {correlation[i, j]:+.3f})"
                )
    return tuple(notes)


def _company(correlation: Array, i: int) -> list[int]:
    """Return the parameters (three at most) that move along with one, none where it is alone.

    Together they make up for it where they leave a small share of its variance.
    """
    own = float(np.linalg.pinv(correlation, rcond=1e-12, hermitian=True)[i, i])
    if own * (1 - CLOSE**2) < 1:
        return []
    far = np.abs(correlation[i])
    return [int(j) for j in np.argsort(-far) if j != i and far[j] > MEMBER][:3]


def notes_of(
    problem: Problem, rest: ConvergedFit, remainder: HeldOutCheck, odds: float | None,
    estimates: tuple[Estimate, ...],
) -> tuple[str, ...]:  # fmt: skip
    """Return what deserves a second look."""
    notes = []
    if not rest.converged:
        notes.append(
            "the fit did not converge: take its figures for where it stood, and fit fewer "
            "effects or measure more poses"
        )
    bound = [e.name for e in estimates if e.on_bound]
    if bound:
        notes.append(f"on their bound: {', '.join(bound)}")
    outliers = np.flatnonzero(~rest.inliers)
    if len(outliers):
        notes.append(f"{len(outliers)} outlier(s) down-weighted")
    if len(remainder.outliers):
        rows = ", ".join(str(int(r) + 1) for r in remainder.outliers)
        notes.append(f"held-out reading(s) far beyond the predicted spread: row {rows}")
    if odds is not None and odds < AT_ODDS:
        notes.append(
            "what differs between loads and all readings together disagree on the flexibilities: "
            "something else changes with the load, or came between the loads (a wrong payload, a "
            "tool that slipped, an instrument that moved)"
        )
    if not problem.stages.possible and problem.stages.elastic.any():
        notes.append(
            "no pose was measured under two loads: flexibilities rest on geometry and load together"
        )
    return tuple(notes)


def verdict_of(
    errors: tuple[Errors, ...], rest: ConvergedFit, floor: float, complete: bool, remaining: str
) -> str:
    """Return the calibration in one sentence."""
    held = len(errors[2].rows) > 0
    before, after = (errors[2], errors[3]) if held else (errors[0], errors[1])
    where = "on poses that the fit never saw" if held else "on the fitted poses (none held out)"
    change = "rises" if after.rms > before.rms else "falls"
    text = (
        f"the error {change} from {1e3 * before.rms:.3f} to {1e3 * after.rms:.3f} mm rms {where}; "
        f"the fit leaves {1e3 * rest.noise.coordinate():.3f} mm a coordinate"
    )
    if np.isfinite(floor):
        text += f" (instrument and arm alone: {1e3 * floor:.3f} mm)"
    return f"{text}; {'' if complete else 'not complete: '}{remaining}"


def remaining_of(
    remainder: HeldOutCheck, diagnosis: Diagnosis | None, complete: bool,
    missing: tuple[MissingEffect, ...], converged: bool,
) -> str:  # fmt: skip
    """Return what is left: one statement, which every section of a report repeats."""
    if complete:
        return "nothing is left that a further effect could explain"
    if not converged:
        return "the fit did not converge"
    if missing:
        names = ", ".join(f"{lack.name} ({100 * lack.share:.0f} %)" for lack in missing)
        return (
            "to be added, with the share that each takes off what is left on poses left out of its "
            f"fit: {names}"
        )
    left = [] if diagnosis is None else sorted(
        {cause.effect for c in diagnosis.channels for cause in c.causes}
    )  # fmt: skip
    if left:
        return f"{', '.join(left)} is left to be added"
    if diagnosis is not None and diagnosis.verdict != "no_gap":
        return "structure is left that no effect of the catalogue explains"
    return f"held-out poses are {np.sqrt(remainder.ratio):.1f} times as far off as predicted"


def unsupported(estimates: tuple[Estimate, ...], names: tuple[str, ...]) -> tuple[str, ...]:
    """Return those of the effects ``names`` that a fit does not bear out.

    An effect is borne out where one of its numbers is more than three of its own sigmas from zero
    and off its bounds.
    """
    return tuple(
        name
        for name in names
        if not any(
            abs(e.value) > SIGMAS * e.std and e.shown and not e.on_bound
            for e in estimates
            if e.name == name or e.name.startswith(f"{name}_")
        )
    )
