"""What carries from session to session: each cause's value, session by session.

A cause is fitted with a value of its own in each session, all other causes shared. It carries where
the values agree; where they differ by more than chance and by more than a model cares for, it has
changed, and is named as changed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import CHANCE, EXCITED, MATERIAL_SHARE
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.effects import Reported
from gapbridge.core.estimation.least_squares import inverse, solve, squared_sigmas

DEAD = 1e-7  # share of a parameter's column that a session has: below, it shows nothing of it


@dataclass(frozen=True)
class Carried:
    """One effect's values in the sessions that show it."""

    effect: str
    carries: bool
    p_value: float  # that sessions with one value differ as much
    values: tuple[tuple[int, tuple[Reported, ...]], ...]  # session, its parameters


def carried(selection: Selection, chosen: Sequence[int], arm: Arm) -> tuple[Carried, ...]:
    """Return how the effects of the ``chosen`` candidates carry; () where there is one session."""
    session = selection.observation.session
    if session is None:
        return ()
    of_row = np.repeat(session[selection.kept], selection.observation.measured.shape[1])
    space = selection.space
    effects = dict.fromkeys(space.candidates[c].family for c in chosen)
    effects_carried = []
    for effect in effects:
        members = [c for c in chosen if space.candidates[c].family == effect]
        rest = [c for c in chosen if c not in members]
        compared = _compared(selection, members, rest, of_row, arm)
        if compared is not None:
            effects_carried.append(compared)
    return tuple(effects_carried)


def _compared(
    selection: Selection, members: list[int], rest: list[int], of_row: NDArray[np.int64], arm: Arm
) -> Carried | None:
    """Return how one effect carries; None where fewer than two sessions show it."""
    space, unprojected = selection.space, selection.unprojected
    columns = unprojected.columns(space, members)
    usual = np.concatenate([space.candidates[c].scales for c in members])
    shown = [
        int(s) for s in np.unique(of_row)
        if np.sqrt(np.sum((columns[of_row == s] * usual) ** 2, axis=0)).max() > EXCITED
    ]  # fmt: skip
    if len(shown) < 2:
        return None
    beside = np.hstack([unprojected.columns(space, rest), unprojected.nuisance])
    values, covariance, alive = _fitted_by_session(selection, columns, beside, of_row, shown)
    everywhere = alive.all(axis=0)
    if not everywhere.any():
        return None
    compared = np.flatnonzero(np.tile(everywhere, len(shown)))
    p_value, matters = _differing(
        values[:, everywhere], covariance[np.ix_(compared, compared)],
        columns[:, everywhere], of_row, shown,
    )  # fmt: skip
    reported, width = [], columns.shape[1]
    for i, s in enumerate(shown):
        block = slice(i * width, (i + 1) * width)
        reported.append(
            (s, _reported(space.candidates, members, values[i], covariance[block, block], arm))
        )
    effect = space.candidates[members[0]].family
    return Carried(effect, not (p_value < CHANCE and matters), p_value, tuple(reported))


def _fitted_by_session(
    selection: Selection, columns: Array, beside: Array, of_row: NDArray[np.int64],
    shown: list[int],
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return the values (S, d) of an effect in each session, what is ``beside`` shared by all.

    With them their covariance (S d, S d), and which of them (S, d) the session shows at all.
    """
    target, count = selection.unprojected.target, len(shown) * columns.shape[1]
    A = np.hstack([*(columns * (of_row == s)[:, None] for s in shown), beside])
    size = np.sqrt(np.einsum("ij,ij->j", A, A))
    whole = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    alive = size > DEAD * np.concatenate([np.tile(whole, len(shown)), size[count:]])
    A = A * alive
    solution = solve(A, target)
    residual = target - A @ solution
    freedom = max(len(residual) * selection.rows_each - A.shape[1], 1)
    variance = max(float(residual @ residual) / freedom, selection.space.floor)
    covariance = inverse(A.T @ A)[:count, :count] * variance
    shape = (len(shown), columns.shape[1])
    return solution[:count].reshape(shape), covariance, alive[:count].reshape(shape)


def _differing(
    values: Array, covariance: Array, columns: Array, of_row: NDArray[np.int64], shown: list[int]
) -> tuple[float, bool]:
    """Return the probability of such differences (S, d) by chance, and whether they matter."""
    from scipy.special import gammaincc

    count, width = values.shape
    C = np.kron(np.eye(count)[1:] - np.eye(count)[0], np.eye(width))  # each against the first
    apart = C @ values.ravel()
    spread = C @ covariance @ C.T
    square = squared_sigmas(apart, spread)
    p_value = float(gammaincc(len(apart) / 2, square / 2))
    mean = values.mean(axis=0)
    change = np.concatenate(
        [columns[of_row == s] @ (values[i] - mean) for i, s in enumerate(shown)]
    )
    whole = np.concatenate([columns[of_row == s] @ mean for s in shown])
    return p_value, bool(change @ change > MATERIAL_SHARE**2 * (whole @ whole))


def _reported(
    candidates: Sequence[Candidate], members: list[int], x: Array, covariance: Array, arm: Arm
) -> tuple[Reported, ...]:
    reported: list[Reported] = []
    start = 0
    for c in members:
        candidate = candidates[c]
        part = slice(start, start + len(candidate.parameters))
        reported += candidate.effect.reported(arm, candidate.term(x[part]), covariance[part, part])
        start = part.stop
    return tuple(reported)
