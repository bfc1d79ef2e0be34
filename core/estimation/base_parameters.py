"""Identifiability of the flexibilities: alone, in combination, or not at all.

Flexibilities with a large standard deviation relative to their prior are fixed at the model's
value, one after the other, the one with the least cost first. The remaining ones are base
parameters: they include the effect of those that are collinear with them (Gautier, Khalil, IEEE
Trans. Robotics and Automation 6 (1990) 368).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.effects import flexibility_names
from gapbridge.core.estimation.compliance_fit import ProjectedSystem, solve
from gapbridge.core.estimation.robust import TINY
from gapbridge.core.notes import Note, Reason

MAX_RELATIVE_STD = 0.3  # of the prior's sigma; beyond it a flexibility is not identifiable
VISIBLE = float(np.sqrt(MAX_RELATIVE_STD**-2 - 1))  # column length over noise, identifiable alone
COLLINEAR = 0.98  # correlation from which two parameters count as one combination
MIN_MEMBER_SHARE = 0.1  # of a combination, from which a flexibility is named


@dataclass(frozen=True)
class Identifiable:
    """Which flexibilities are identifiable, and their covariance."""

    kept: Mask  # (2n,) fitted; the others are fixed at the model's value
    covariance: Array  # (2n, 2n), (rad/Nm)^2: of the kept ones; the prior's variance of the others
    notes: tuple[Note, ...]  # what is not identifiable, or only in combination
    noise: float  # of the residual, over the one that the rows were divided by


def residual_noise(
    linear: ProjectedSystem, values: Array, kept: Mask, sigma: float, spare: float
) -> float:
    """Return the noise of a fit's residual per degree of freedom, over that of the system's rows.

    That one is a median of gaps, which the fitted parameters make smaller. ``values`` (2n,) are the
    fit's, ``sigma`` the prior's (rad/Nm), ``spare`` the equations less the nuisances.
    """
    free = kept & (values > 0)
    size = np.linalg.svd(linear.matrix[:, free] * sigma, compute_uv=False) ** 2
    left = linear.matrix @ values - linear.right
    freedom = max(spare - float(np.sum(size / (size + 1))), 1.0)
    return max(float(np.sqrt(left @ left / freedom)), TINY)


def choose_identifiable(
    linear: ProjectedSystem, prior: tuple[Array, float], noise: float = 1.0
) -> Mask:
    """Return the flexibilities (2n,) that are identifiable with the others fixed.

    ``noise`` is the ``residual_noise``.
    """
    linear = linear.over(noise)
    kept = np.ones(len(prior[0]), dtype=bool)
    while kept.any():
        undetermined = np.flatnonzero(kept)[
            _relative_std(linear, kept, prior[1]) > MAX_RELATIVE_STD
        ]
        if not len(undetermined):
            break
        costs = np.array([_cost_without(linear, kept, int(i), prior) for i in undetermined])
        equally_cheap = costs <= costs.min() + max(1.0, 1e-9 * costs.min())
        # among equal costs, the one with the shortest column
        size = np.linalg.norm(linear.matrix[:, undetermined], axis=0)
        kept[undetermined[np.argmin(np.where(equally_cheap, size, np.inf))]] = False
    return kept


def _relative_std(linear: ProjectedSystem, kept: Mask, sigma: float) -> Array:
    """Return the standard deviations of the kept flexibilities, in the prior's sigma."""
    return np.asarray(np.linalg.norm(_covariance_root(linear, kept, sigma), axis=1))


def _covariance_root(linear: ProjectedSystem, kept: Mask, sigma: float) -> Array:
    """Return a root (k, k) of the kept ones' covariance in units of the prior's variance."""
    size = int(kept.sum())
    R = np.linalg.qr(np.vstack([linear.matrix[:, kept] * sigma, np.eye(size)]), mode="r")
    return np.linalg.solve(R, np.eye(size))


def _cost_without(
    linear: ProjectedSystem, kept: Mask, removed: int, prior: tuple[Array, float]
) -> float:
    """Return the sum of squares of the best fit with one more flexibility fixed."""
    mask = kept.copy()
    mask[removed] = False
    solution = solve(linear, mask, prior[0].copy(), prior)
    remaining = linear.matrix @ solution - linear.right
    return float(remaining @ remaining + np.sum(((solution - prior[0]) / prior[1]) ** 2))


def identifiability_of(
    linear: ProjectedSystem, kept: Mask, sigma: float, noise: float = 1.0
) -> Identifiable:
    """Return covariance and notes of the chosen flexibilities.

    ``sigma`` is the prior's (rad/Nm), ``noise`` the ``residual_noise``.
    """
    linear, count = linear.over(noise), len(kept)
    covariance = np.diag(np.full(count, sigma**2))
    root = _covariance_root(linear, kept, sigma) * sigma
    covariance[np.ix_(kept, kept)] = root @ root.T
    columns = linear.matrix * sigma
    notes = [_held_note(int(i), columns, kept) for i in np.flatnonzero(~kept)]
    notes += _identifiable_combinations(columns, kept)
    names = flexibility_names(count // 2)
    notes += correlated_pairs(covariance, kept, names)
    return Identifiable(kept, covariance, tuple(notes), noise)


def _held_note(i: int, columns: Array, kept: Mask) -> Note:
    """Return why flexibility ``i`` is fixed, and which others are equivalent to it."""
    names, size = flexibility_names(len(kept) // 2), float(np.linalg.norm(columns[:, i]))
    if size > VISIBLE and kept.any():
        share = np.linalg.lstsq(columns[:, kept], columns[:, i], rcond=1e-9)[0]
        remaining = np.linalg.norm(columns[:, i] - columns[:, kept] @ share)
        reach = np.abs(share) * np.linalg.norm(columns[:, kept], axis=0) / size
        members = tuple(
            (float(share[k]), names[np.flatnonzero(kept)[k]])
            for k in np.argsort(-reach)[:3]
            if reach[k] > MIN_MEMBER_SHARE
        )
        if members and remaining < MAX_RELATIVE_STD * size:
            return Note(Reason.ACTS_LIKE, (names[i], members))
    return Note(Reason.HELD, (names[i],))


def _identifiable_combinations(columns: Array, kept: Mask) -> list[Note]:
    """Return identifiable combinations of flexibilities that are not identifiable alone."""
    held, names = np.flatnonzero(~kept), flexibility_names(len(kept) // 2)
    if len(held) < 2:
        return []
    remaining = columns[:, held]
    if kept.any():
        remaining = (
            remaining
            - columns[:, kept] @ np.linalg.lstsq(columns[:, kept], remaining, rcond=1e-9)[0]
        )
    values, vectors = np.linalg.eigh(remaining.T @ remaining)
    notes = []
    for value, vector in zip(values, vectors.T, strict=True):
        members = np.flatnonzero(np.abs(vector) > 0.3 * np.abs(vector).max())
        if value > VISIBLE**2 and len(members) > 1:
            sign = np.sign(vector[members[0]])
            parts = tuple((float(sign * vector[k]), names[held[k]]) for k in members)
            notes.append(Note(Reason.SHOWN_TOGETHER, (parts,)))
    return notes


def correlated_pairs(covariance: Array, shown: Mask, names: Sequence[str]) -> list[Note]:
    """Return the highly correlated pairs of identifiable parameters (p,)."""
    notes, std = [], np.sqrt(np.diag(covariance))
    for i, j in combinations(np.flatnonzero(shown & (std > 0)).tolist(), 2):
        correlation = float(covariance[i, j] / (std[i] * std[j]))
        if abs(correlation) > COLLINEAR:
            known = Reason.DIFFERENCE_KNOWN if correlation > 0 else Reason.SUM_KNOWN
            notes.append(Note(known, (names[i], names[j], correlation)))
    return notes
