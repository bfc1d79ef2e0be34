"""Which flexibilities the data show, which only together with others, and which not at all.

A flexibility that stays vague against its prior is held at the model's value, one after the other,
the one first whose absence costs the fit least. What is left carries, for combinations of which
the data know one number only, the whole of it (base parameters, in the robotics literature's sense:
Gautier, Khalil, IEEE Trans. Robotics and Automation 6 (1990) 368).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.effects import flexibility_names
from gapbridge.core.estimation.compliance_fit import Linear, solve
from gapbridge.core.notes import Note, Reason

VAGUE = 0.3  # of the prior's sigma: what is known no better counts as not identifiable
VISIBLE = float(
    np.sqrt(VAGUE**-2 - 1)
)  # length of a column, in units of noise, that is shown alone
CLOSE = 0.98  # correlation from which two parameters count as one combination
MEMBER = 0.1  # share of a combination from which a flexibility is named in it


@dataclass(frozen=True)
class Identifiable:
    """What a problem shows."""

    kept: Mask  # (2n,) fitted; the others stay at the model's value
    covariance: Array  # (2n, 2n): of the kept ones, the others held; prior's square for the others
    reported: tuple[Note, ...]  # what is not identifiable, or only in combination


def choose(linear: Linear, prior: tuple[Array, float]) -> Mask:
    """Return the flexibilities (2n,) that the data show once the others are held."""
    kept = np.ones(len(prior[0]), dtype=bool)
    while kept.any():
        vague = np.flatnonzero(kept)[_spread(linear, kept, prior[1]) > VAGUE]
        if not len(vague):
            break
        costs = np.array([_cost(linear, kept, int(i), prior) for i in vague])
        cheap = costs <= costs.min() + max(1.0, 1e-9 * costs.min())
        # of those that are missed alike, the one that the data show least by itself
        alone = np.linalg.norm(linear.matrix[:, vague], axis=0)
        kept[vague[np.argmin(np.where(cheap, alone, np.inf))]] = False
    return kept


def _spread(linear: Linear, kept: Mask, sigma: float) -> Array:
    """Return the standard deviations of the kept flexibilities, in the prior's sigma."""
    return np.asarray(np.linalg.norm(_root(linear, kept, sigma), axis=1))


def _root(linear: Linear, kept: Mask, sigma: float) -> Array:
    """Return a root (k, k) of the kept ones' covariance in units of the prior's variance."""
    size = int(kept.sum())
    R = np.linalg.qr(np.vstack([linear.matrix[:, kept] * sigma, np.eye(size)]), mode="r")
    return np.linalg.solve(R, np.eye(size))


def _cost(linear: Linear, kept: Mask, held: int, prior: tuple[Array, float]) -> float:
    """Return the sum of squares of the best fit with one more flexibility held."""
    mask = kept.copy()
    mask[held] = False
    found = solve(linear, mask, prior[0].copy(), prior)
    left = linear.matrix @ found - linear.right
    return float(left @ left + np.sum(((found - prior[0]) / prior[1]) ** 2))


def what_is_shown(linear: Linear, kept: Mask, sigma: float) -> Identifiable:
    """Return covariance and notes of the chosen flexibilities; sigma is the prior's (rad/Nm)."""
    count = len(kept)
    covariance = np.diag(np.full(count, sigma**2))
    root = _root(linear, kept, sigma) * sigma
    covariance[np.ix_(kept, kept)] = root @ root.T
    columns = linear.matrix * sigma
    reported = [_held(int(i), columns, kept) for i in np.flatnonzero(~kept)]
    reported += _faint(columns, kept)
    names = flexibility_names(count // 2)
    reported += hardly_separated(covariance, kept, names)
    return Identifiable(kept, covariance, tuple(reported))


def _held(i: int, columns: Array, kept: Mask) -> Note:
    """Return why flexibility ``i`` is held, and which others stand for it."""
    names, size = flexibility_names(len(kept) // 2), float(np.linalg.norm(columns[:, i]))
    if size > VISIBLE and kept.any():
        share = np.linalg.lstsq(columns[:, kept], columns[:, i], rcond=1e-9)[0]
        left = np.linalg.norm(columns[:, i] - columns[:, kept] @ share)
        reach = np.abs(share) * np.linalg.norm(columns[:, kept], axis=0) / size
        members = tuple(
            (float(share[k]), names[np.flatnonzero(kept)[k]])
            for k in np.argsort(-reach)[:3]
            if reach[k] > MEMBER
        )
        if members and left < VAGUE * size:
            return Note(Reason.ACTS_LIKE, (names[i], members))
    return Note(Reason.HELD, (names[i],))


def _faint(columns: Array, kept: Mask) -> list[Note]:
    """Return combinations that show although none of their members does."""
    held, names = np.flatnonzero(~kept), flexibility_names(len(kept) // 2)
    if len(held) < 2:
        return []
    left = columns[:, held]
    if kept.any():
        left = left - columns[:, kept] @ np.linalg.lstsq(columns[:, kept], left, rcond=1e-9)[0]
    values, vectors = np.linalg.eigh(left.T @ left)
    reported = []
    for value, vector in zip(values, vectors.T, strict=True):
        members = np.flatnonzero(np.abs(vector) > 0.3 * np.abs(vector).max())
        if value > VISIBLE**2 and len(members) > 1:
            sign = np.sign(vector[members[0]])
            parts = tuple((float(sign * vector[k]), names[held[k]]) for k in members)
            reported.append(Note(Reason.SHOWN_TOGETHER, (parts,)))
    return reported


def hardly_separated(covariance: Array, shown: Mask, names: Sequence[str]) -> list[Note]:
    """Return the pairs of shown parameters (p,) that the data hardly separate."""
    reported, std = [], np.sqrt(np.diag(covariance))
    for i, j in combinations(np.flatnonzero(shown & (std > 0)).tolist(), 2):
        correlation = float(covariance[i, j] / (std[i] * std[j]))
        if abs(correlation) > CLOSE:
            known = Reason.DIFFERENCE_KNOWN if correlation > 0 else Reason.SUM_KNOWN
            reported.append(Note(known, (names[i], names[j], correlation)))
    return reported
