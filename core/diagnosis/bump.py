"""Lines that are one shape: a localised one in a joint's angle is no period of its gears.

Nor is, beside something unknown, a line of which the joint's range shows less than a period.
"""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import MIN_PERIODS, SMOOTH_PENALTY
from gapbridge.core.diagnosis.selection.candidate import joint_quantity
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.estimation.least_squares import basis_of, projected_out
from gapbridge.core.estimation.nelder_mead import nelder_mead

PLACES, WIDTHS = 13, (0.05, 0.1, 0.2)  # where a bump is first looked for, in shares of the range


def bumps(selection: Selection) -> set[int]:
    """Return lines of a joint, with its offset, for which one bump in its angle does as well.

    Place and width of the bump are free; it wins ties.
    """
    space, observation = selection.working, selection.observation
    if observation.channel != "position" or observation.joint_columns is None:
        return set()
    chosen = [c for c in selection.best.chosen if space.candidates[c].named]
    bump_like: set[int] = set()
    if len(chosen) < len(selection.best.chosen):
        bump_like = {c for c in chosen if _periods(selection, c) < MIN_PERIODS}
    for i in range(observation.joint_columns.shape[2]):
        here = [c for c in chosen if space.candidates[c].site.joint == i + 1]
        lines = [c for c in here if space.candidates[c].periodic]
        if len(lines) < 2:
            continue
        group = [c for c in here if space.candidates[c].turns_its_joint]
        rest = basis_of(space.columns([c for c in chosen if c not in group]))
        y = projected_out(rest, space.y)
        basis = basis_of(projected_out(rest, space.columns(group)))
        lines_score = float(space.misfit(np.array(y @ y - np.sum((basis.T @ y) ** 2))))
        bump = float(space.misfit(np.array(_best_bump(selection, i, rest, y))))
        penalty = 3 * np.log(space.freedom) + 2 * np.log(len(space.candidates)) + SMOOTH_PENALTY
        if bump + penalty <= lines_score + float(space.penalty[group].sum()):
            bump_like |= set(group)
    return bump_like


def _periods(selection: Selection, c: int) -> float:
    """Return how many periods of a line its joint's range shows; inf of what is no line."""
    site = selection.working.candidates[c].site
    if site.order is None or site.joint is None:
        return np.inf
    angle = selection.observation.quantities[joint_quantity(selection.observation, site.joint - 1)]
    return float(np.ptp(angle)) * site.order / (2 * np.pi)


def _best_bump(selection: Selection, i: int, rest: Array, y: Array) -> float:
    """Return what the best Gaussian bump in joint i's angle leaves of |y|^2."""
    observation = selection.observation
    assert observation.joint_columns is not None
    joint = observation.joint_columns[:, :, i, None]
    z = observation.quantities[joint_quantity(observation, i)]
    low, span = float(z.min()), float(np.ptp(z))

    def rest_squares(place_width: Array) -> float:
        bump = np.exp(-0.5 * ((z - place_width[0]) / np.exp(place_width[1])) ** 2)
        x = selection.rows_of(joint * bump[:, None, None])[:, 0]
        x = projected_out(rest, x)
        size = float(x @ x)
        return float(y @ y) - (float(x @ y) ** 2 / size if size > 1e-9 else 0.0)

    tries = [np.array([low + s * span, np.log(w * span)])
             for s in np.linspace(0, 1, PLACES) for w in WIDTHS]  # fmt: skip
    best = min(tries, key=rest_squares)
    return nelder_mead(rest_squares, best, 120)[1]
