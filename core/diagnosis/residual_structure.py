"""Structure of the residual: whether there is any, and the quantities that it depends on.

The test is a variance-component score test (Goeman's global test) of the residual against all
columns of the catalogue and of the smooth functions. It adds up many small contributions, none of
which is significant alone given the number of hypotheses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import SAME_SHARE
from gapbridge.core.diagnosis.observation import HELD_TORQUE
from gapbridge.core.diagnosis.selection.candidate import target_of
from gapbridge.core.diagnosis.selection.sample_space import SampleSpace
from gapbridge.core.estimation.held_out import random_folds
from gapbridge.core.estimation.least_squares import basis_of, projected_out

DRAWS = 1500
AT_ONCE = 40  # directions: with all draws 0.5 MB
FOLDS = 7
SEED = 0


def structure_p_value(space: SampleSpace, nuisance: Array, chosen: Sequence[int]) -> float:
    """Return the p-value of the residual's structure under noise alone."""
    fitted = basis_of(np.hstack([nuisance, space.columns(chosen)]))
    residuals = np.empty((1 + DRAWS, len(space.y)))
    residuals[0] = space.y
    np.random.default_rng(SEED).standard_normal(out=residuals[1:])
    residuals -= (residuals @ fitted) @ fitted.T
    whole = np.einsum("ij,ij->i", residuals, residuals)
    if not whole[0]:
        return 1.0
    worst = []
    for columns, sizes in _families(space, fitted):
        # sums of squares along the family's directions, as a share of everything left
        share = _squares_along(space.X, columns, sizes, residuals) / whole
        mean, deviation = float(share[1:].mean()), float(share[1:].std()) + 1e-300
        worst.append((share - mean) / deviation)
    if not worst:  # what is fitted leaves no direction to any column
        return 1.0
    top = np.max(np.array(worst), axis=0)  # the most significant family, of data and of each draw
    return float((1 + np.sum(top[1:] >= top[0])) / (1 + DRAWS))


def _squares_along(X: Array, columns: NDArray[np.int64], sizes: Array, residuals: Array) -> Array:
    """Return the sum of squares of every residual (D, m) along the columns, a few at once."""
    m, count = len(X), len(columns)
    if m * (count + len(residuals)) < len(residuals) * count:  # fewer products by squares of rows
        unit = X[:, columns] / sizes
        return np.asarray(np.einsum("ij,ij->i", residuals @ (unit @ unit.T), residuals))
    total = np.zeros(len(residuals))
    for few in np.array_split(np.arange(len(columns)), 1 + len(columns) // AT_ONCE):
        along = residuals @ (X[:, columns[few]] / sizes[few])
        total += np.einsum("ij,ij->i", along, along)
    return total


def _families(space: SampleSpace, fitted: Array) -> Iterator[tuple[NDArray[np.int64], Array]]:
    """Yield for every family its column indices (K,) and their norms outside ``fitted`` (K,).

    The residual is orthogonal to ``fitted``, so its products with the columns need no projection.
    """
    groups: dict[str, list[int]] = {}
    for c, candidate in enumerate(space.candidates):
        key = candidate.family if candidate.named else f"{candidate.family} {candidate.target}"
        groups.setdefault(key, []).append(c)
    within = fitted.T @ space.X
    whole = np.einsum("ij,ij->j", space.X, space.X)
    square = whole - np.einsum("ij,ij->j", within, within)
    for members in groups.values():
        columns = space.column_indices(members)
        columns = columns[square[columns] > 1e-8 * whole[columns]]
        if len(columns):
            yield columns, np.sqrt(square[columns])


def dependence(
    space: SampleSpace, nuisance: Array, chosen: Sequence[int], groups: NDArray[np.int64]
) -> list[tuple[str, float]]:
    """Return quantities and the share of the residual that each predicts held out, best first.

    ``groups`` (m,) says which rows of the sample space are held out together.
    """
    fitted = basis_of(np.hstack([nuisance, space.columns(chosen)]))
    r = projected_out(fitted, space.y)
    fold = random_folds(groups, FOLDS, SEED)
    by_size: dict[int, list[int]] = {}
    for c, candidate in enumerate(space.candidates):
        if not candidate.named and candidate.quantity:
            by_size.setdefault(int(space.start[c + 1] - space.start[c]), []).append(c)
    shares: dict[int, float] = {}
    for size, members in by_size.items():
        for few in np.array_split(members, 1 + len(members) * size // AT_ONCE):
            columns = space.X[:, space.column_indices(few.tolist())]
            clean = projected_out(fitted, columns)
            blocks = clean.reshape(len(r), len(few), size).transpose(1, 0, 2)
            shares |= zip(few.tolist(), _held_out_shares(blocks, r, fold).tolist(), strict=True)
    constant: dict[str, float] = {}  # by target: the largest share of functions that contain one
    for c, share in shares.items():
        k = space.candidates[c]
        if k.target == target_of(k.quantity, "actual_q", "target_q"):
            constant[k.target] = max(constant.get(k.target, share), share)
    best: dict[str, float] = {}
    for c in sorted(shares):
        k, share = space.candidates[c], shares[c]
        # what a constant predicts as well does not depend on time: the first jump is nearly one
        if k.jumps and not _beyond(constant.setdefault(k.target, share), share):
            continue
        best[k.quantity] = max(best.get(k.quantity, -np.inf), share)
    return _one_of_a_kind(_loads_before_time(sorted(best.items(), key=lambda item: -item[1])))


def _beyond(constant: float, share: float) -> bool:
    """Return whether a share is clearly larger than a constant's, or leaves less than half."""
    return share > constant + min(SAME_SHARE, (1 - constant) / 2)


def _loads_before_time(ranked: list[tuple[str, float]]) -> list[tuple[str, float]]:
    """Return the ranking with time after static torques that predict about equally much.

    Anything that happens once in a log correlates with its time.
    """
    place = next((i for i, (name, _) in enumerate(ranked) if name == "timestamp"), None)
    if place is None:
        return ranked
    least = ranked[place][1] - SAME_SHARE
    equal = [
        i for i, (name, share) in enumerate(ranked)
        if i > place and name.startswith(HELD_TORQUE) and share > least
    ]  # fmt: skip
    if equal:
        ranked.insert(equal[-1], ranked.pop(place))
    return ranked


def _one_of_a_kind(ranked: list[tuple[str, float]]) -> list[tuple[str, float]]:
    """Return the ranking with the best joint temperature only: all are correlated."""
    kept: list[tuple[str, float]] = []
    for name, share in ranked:
        warm = name.startswith("joint_temperatures_")
        if warm and any(n.startswith("joint_temperatures_") for n, _ in kept):
            continue
        kept.append((name, share))
    return kept


def _held_out_shares(columns: Array, r: Array, fold: NDArray[np.int64]) -> Array:
    """Return the share of r (m,) that each block of columns (B, m, d) predicts held out (B,)."""
    by_fold = np.argsort(fold, kind="stable")
    ends = np.searchsorted(fold[by_fold], np.arange(FOLDS + 1))
    if not r.any():
        return np.zeros(len(columns))
    unit, r = columns[:, by_fold], r[by_fold]
    unit = unit / (np.sqrt(np.einsum("bij,bij->bj", unit, unit))[:, None] + 1e-300)
    flipped = unit.transpose(0, 2, 1)
    G, g = flipped @ unit + 1e-6 * np.eye(columns.shape[2]), flipped @ r
    residual_squares = np.zeros(len(columns))
    for begin, end in pairwise(ends):
        U, V, u = unit[:, begin:end], flipped[:, :, begin:end], r[begin:end]
        x = np.linalg.solve(G - V @ U, (g - V @ u)[..., None])
        residual_squares += np.sum((u - (U @ x)[..., 0]) ** 2, axis=1)
    return np.asarray(1 - residual_squares / float(r @ r))
