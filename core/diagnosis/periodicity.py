"""Periodic lines of a joint that are not periodic: one local bump in its angle fits equally well.

With an unnamed function in the set, or with the joint's own offset, a line also needs most of a
period in the joint's range: less of it and an offset are the arc of any curve.
"""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import MIN_PERIODS, SMOOTH_PENALTY
from gapbridge.core.diagnosis.selection.candidate import joint_quantity
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.estimation.least_squares import basis_of, projected_out
from gapbridge.core.estimation.nelder_mead import nelder_mead

CENTRES, WIDTHS = 13, (0.05, 0.1, 0.2)  # start values of a bump, as shares of the joint's range


def not_periodic(selection: Selection) -> set[int]:
    """Return the candidates (a joint's lines and offset) that no period proves.

    One bump in the joint's angle replaces them; its centre and width are free, and it wins ties.
    """
    space, observation = selection.working, selection.observation
    if observation.channel != "position" or observation.joint_columns is None:
        return set()
    chosen = [c for c in selection.best.chosen if space.candidates[c].named]
    few = {c for c in chosen if _periods(selection, c) < MIN_PERIODS}
    bump_like = set(few) if len(chosen) < len(selection.best.chosen) else set()
    for i in range(observation.joint_columns.shape[2]):
        of_joint = [c for c in chosen if space.candidates[c].site.joint == i + 1]
        lines = [c for c in of_joint if space.candidates[c].periodic]
        group = [c for c in of_joint if space.candidates[c].turns_joint_by_own_angle]
        if len(group) > len(lines):
            bump_like |= few & set(lines)
        if len(lines) < 2:
            continue
        others = basis_of(space.columns([c for c in chosen if c not in group]))
        y = projected_out(others, space.y)
        basis = basis_of(projected_out(others, space.columns(group)))
        lines_score = float(space.misfit(np.array(y @ y - np.sum((basis.T @ y) ** 2))))
        bump = float(space.misfit(np.array(_bump_misfit(selection, i, others, y))))
        penalty = 3 * np.log(space.freedom) + 2 * np.log(len(space.candidates)) + SMOOTH_PENALTY
        if bump + penalty <= lines_score + float(space.penalty[group].sum()):
            bump_like |= set(group)
    return bump_like


def _periods(selection: Selection, c: int) -> float:
    """Return how many periods of a line its joint's range shows; inf for other candidates."""
    site = selection.working.candidates[c].site
    if site.order is None or site.joint is None:
        return np.inf
    angle = selection.observation.quantities[joint_quantity(selection.observation, site.joint - 1)]
    return float(np.ptp(angle)) * site.order / (2 * np.pi)


def _bump_misfit(selection: Selection, i: int, others: Array, y: Array) -> float:
    """Return the residual sum of squares of ``y`` under the best bump in joint i's angle."""
    observation = selection.observation
    assert observation.joint_columns is not None
    joint = observation.joint_columns[:, :, i, None]
    z = observation.quantities[joint_quantity(observation, i)]
    low, span = float(z.min()), float(np.ptp(z))

    def residual_squares(place_width: Array) -> float:
        bump = np.exp(-0.5 * ((z - place_width[0]) / np.exp(place_width[1])) ** 2)
        x = selection.rows_of(joint * bump[:, None, None])[:, 0]
        x = projected_out(others, x)
        size = float(x @ x)
        return float(y @ y) - (float(x @ y) ** 2 / size if size > 1e-9 else 0.0)

    tries = [np.array([low + s * span, np.log(w * span)])
             for s in np.linspace(0, 1, CENTRES) for w in WIDTHS]  # fmt: skip
    best = min(tries, key=residual_squares)
    return nelder_mead(residual_squares, best, 120)[1]
