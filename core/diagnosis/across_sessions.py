"""Transfer between sessions: whether each cause has the same value in every session.

A cause is fitted with one value per session, all other causes with shared values. It transfers if
the values agree, or if their difference is not significant or does not matter to a model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import MATERIAL_SHARE, MIN_EXCITATION, SESSIONS_DIFFER_P
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.effects import Reported
from gapbridge.core.estimation.least_squares import inverse, solve, squared_sigmas

MIN_COLUMN_SHARE = 1e-7  # of a parameter's column in a session, for the session to show it


@dataclass(frozen=True)
class SessionTransfer:
    """One effect's values in the sessions in which it is excited."""

    effect: str
    transfers: bool
    p_value: float  # of such differences if all sessions had one value
    values: tuple[tuple[int, tuple[Reported, ...]], ...]  # session, its parameters


def session_transfer(
    selection: Selection, chosen: Sequence[int], arm: Arm
) -> tuple[SessionTransfer, ...]:
    """Return the transfer of the effects of ``chosen`` candidates; () for a single session."""
    session = selection.observation.session
    if session is None:
        return ()
    of_row = np.repeat(session[selection.kept], selection.observation.measured.shape[1])
    space = selection.space
    effects = dict.fromkeys(space.candidates[c].family for c in chosen)
    transfers = []
    for effect in effects:
        members = [c for c in chosen if space.candidates[c].family == effect]
        others = [c for c in chosen if c not in members]
        compared = _transfer(selection, members, others, of_row, arm)
        if compared is not None:
            transfers.append(compared)
    return tuple(transfers)


def _transfer(
    selection: Selection, members: list[int], others: list[int], of_row: NDArray[np.int64], arm: Arm
) -> SessionTransfer | None:
    """Return the transfer of one effect; None if fewer than two sessions excite it."""
    space, unprojected = selection.space, selection.unprojected
    columns = unprojected.columns(space, members)
    usual = np.concatenate([space.candidates[c].scales for c in members])
    excited = [
        int(s) for s in np.unique(of_row)
        if np.sqrt(np.sum((columns[of_row == s] * usual) ** 2, axis=0)).max() > MIN_EXCITATION
    ]  # fmt: skip
    if len(excited) < 2:
        return None
    shared = np.hstack([unprojected.columns(space, others), unprojected.nuisance])
    values, covariance, alive = _fitted_by_session(selection, columns, shared, of_row, excited)
    everywhere = alive.all(axis=0)
    if not everywhere.any():
        return None
    compared = np.flatnonzero(np.tile(everywhere, len(excited)))
    p_value, matters = _differing(
        values[:, everywhere], covariance[np.ix_(compared, compared)],
        columns[:, everywhere], of_row, excited,
    )  # fmt: skip
    reported, width = [], columns.shape[1]
    for i, s in enumerate(excited):
        block = slice(i * width, (i + 1) * width)
        reported.append(
            (s, _reported(space.candidates, members, values[i], covariance[block, block], arm))
        )
    effect = space.candidates[members[0]].family
    differs = p_value < SESSIONS_DIFFER_P and matters
    return SessionTransfer(effect, not differs, p_value, tuple(reported))


def _fitted_by_session(
    selection: Selection, columns: Array, shared: Array, of_row: NDArray[np.int64],
    excited: list[int],
) -> tuple[Array, Array, Array]:  # fmt: skip
    """Return an effect's values (S, d) per session, fitted with the columns ``shared`` by all.

    With them their covariance (S d, S d), and which of them (S, d) the session shows at all.
    """
    target, count = selection.unprojected.target, len(excited) * columns.shape[1]
    A = np.hstack([*(columns * (of_row == s)[:, None] for s in excited), shared])
    size = np.sqrt(np.einsum("ij,ij->j", A, A))
    whole = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    alive = size > MIN_COLUMN_SHARE * np.concatenate([np.tile(whole, len(excited)), size[count:]])
    A = A * alive
    solution = solve(A, target)
    residual = target - A @ solution
    freedom = max(len(residual) * selection.rows_each - A.shape[1], 1)
    variance = max(float(residual @ residual) / freedom, selection.space.floor)
    covariance = inverse(A.T @ A)[:count, :count] * variance
    shape = (len(excited), columns.shape[1])
    return solution[:count].reshape(shape), covariance, alive[:count].reshape(shape)


def _differing(
    values: Array, covariance: Array, columns: Array, of_row: NDArray[np.int64], excited: list[int]
) -> tuple[float, bool]:
    """Return the p-value of the differences of ``values`` (S, d), and whether they matter."""
    from scipy.special import gammaincc

    count, width = values.shape
    C = np.kron(np.eye(count)[1:] - np.eye(count)[0], np.eye(width))  # each against the first
    differences = C @ values.ravel()
    spread = C @ covariance @ C.T
    square = squared_sigmas(differences, spread)
    p_value = float(gammaincc(len(differences) / 2, square / 2))
    mean = values.mean(axis=0)
    change = np.concatenate(
        [columns[of_row == s] @ (values[i] - mean) for i, s in enumerate(excited)]
    )
    whole = np.concatenate([columns[of_row == s] @ mean for s in excited])
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
