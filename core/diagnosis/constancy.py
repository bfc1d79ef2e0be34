"""Whether an accused number is a constant, or the mean of something that goes by a quantity.

Play that opens with the load looks like play, and a joint that is softer on one side like a soft
joint: the catalogue's effect is the first order of what is there. So each accused number is let go
by every quantity of the log in turn, by an unnamed function beside its constant. Where the residual
asks for that and the function is no small part of the constant, the form is not the effect's.
A periodic line is let go by the quarters of its joint's range: gears repeat in each.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import VARIES
from gapbridge.core.diagnosis.selection.candidate import Candidate, joint_quantity
from gapbridge.core.diagnosis.selection.delay_columns import exact_columns
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.diagnosis.selection.smooth import spline_basis
from gapbridge.core.effects import Term
from gapbridge.core.estimation.least_squares import basis_of, projected_out, solve


def not_constant(
    selection: Selection, accused: Sequence[int], beside: Array | None = None
) -> dict[int, str]:
    """Return the candidates, of those accused, whose number is none, and the quantity it goes by.

    ``beside`` (m, d) are the unnamed functions that stand beside the accused, as rows of the sample
    space; None: they are not known (on all rows), and lines alone are judged, which are compared
    with themselves. Poses alone are judged: in motion friction and delay go by a joint's speed in
    their own right.
    """
    if selection.observation.channel != "position":
        return {}
    unnamed = selection.working.X[:, :0] if beside is None else beside
    if selection.links is not None:
        unnamed = selection.links.whitened(unnamed)
    single, goes_by = [c for c in accused if c not in selection.block], {}
    for c in single:
        candidate = selection.working.candidates[c]
        if candidate.periodic or (beside is not None and _is_a_number(candidate)):
            quantity, share = _variation(selection, c, single, unnamed)
            if share > VARIES:
                goes_by[c] = quantity
    return goes_by


def _is_a_number(candidate: Candidate) -> bool:
    """Return whether an effect is one number times a physical quantity.

    Not so offsets, whose mean is theirs whatever else is there, lines, curves and moments.
    """
    effect = candidate.effect
    form = effect.beside_links or effect.together or effect.curved or effect.at_moment
    return not (form or candidate.periodic)


def _variation(
    selection: Selection, c: int, accused: Sequence[int], beside: Array
) -> tuple[str, float]:
    """Return by which quantity a number goes, and how much: rms of what varies over the constant.

    ("", 0) where the residual asks for no variation at the price of chance.
    """
    space, observation = selection.working, selection.observation
    jacobian = exact_columns(observation, space.candidates[c], _others(selection, c))
    constant = selection.rows_of(_by_session(jacobian, observation.quantities.get("session")))
    rest = np.hstack([space.columns([o for o in accused if o != c]), beside])
    basis = basis_of(_unit(np.hstack([constant, rest])))
    residual = projected_out(basis, space.y)
    freedom = max(space.freedom - basis.shape[1], 1.0)
    variance = max(float(residual @ residual) / freedom, space.floor)
    shapes = _shapes(selection, space.candidates[c])
    most, name, varying = 0.0, "", constant[:, :0]
    for quantity, shape in shapes.items():
        columns = jacobian[:, :, :, None] * shape[:, None, None, :]
        rows = _unit(selection.rows_of(columns.reshape(*jacobian.shape[:2], -1)))
        further = basis_of(projected_out(basis, rows))
        gain = float(np.sum((further.T @ residual) ** 2)) / variance
        gain -= further.shape[1] * np.log(space.freedom) + 2 * np.log(len(shapes))
        if gain > most:
            most, name, varying = gain, quantity, rows
    if not name:
        return "", 0.0
    both = np.hstack([constant, varying])
    A = np.hstack([both, rest])
    x = solve(A, space.y)
    whole = both @ x[: both.shape[1]]
    mean = constant @ solve(constant, whole)
    share = float(np.linalg.norm(whole - mean) / max(float(np.linalg.norm(mean)), 1e-300))
    return name, share


def _by_session(columns: Array, session: Array | None) -> Array:
    """Return the columns (N, k, d) with a number for each session: what changed is no variation."""
    if session is None:
        return columns
    each = (session[:, None] == np.unique(session)).astype(float)
    split = columns[:, :, :, None] * each[:, None, None, :]
    return np.asarray(split.reshape(*columns.shape[:2], -1))


def _others(selection: Selection, c: int) -> list[Term]:
    return [t for o, t in zip(selection.term_index, selection.terms, strict=True) if o != c]


def _shapes(selection: Selection, candidate: Candidate) -> dict[str, Array]:
    """Return the functions (N, d) by which a number may go, by the quantity that they go by."""
    quantities = _quantities(selection, candidate)
    if not candidate.periodic:
        return {name: spline_basis(z) for name, z in quantities.items()}
    assert candidate.site.joint is not None
    angle = joint_quantity(selection.observation, candidate.site.joint - 1)
    return {angle: _quarters(quantities[angle])} if angle in quantities else {}


def _quarters(z: Array) -> Array:
    """Return which quarter of a quantity's samples each belongs to (N, 3), centred."""
    quarter = np.searchsorted(np.quantile(z, (0.25, 0.5, 0.75)), z)
    indicators = (quarter[:, None] == np.arange(1, 4)).astype(float)
    return np.asarray(indicators - indicators.mean(axis=0))


def _quantities(selection: Selection, candidate: Candidate) -> dict[str, Array]:
    """Return what a number may go by: the columns of the log, and the load that its joint holds.

    Not by session, nor by time where there are several: what changed between them is reported so.
    """
    observation, joint = selection.observation, candidate.site.joint
    quantities = dict(observation.quantities)
    if "session" in quantities:
        del quantities["session"]
        quantities.pop("timestamp", None)
    if observation.axial_moment is not None and joint is not None:
        quantities["load"] = np.abs(observation.axial_moment[:, joint - 1])
    return {name: z for name, z in quantities.items() if len(np.unique(z)) > 2}


def _unit(columns: Array) -> Array:
    return np.asarray(columns / (np.linalg.norm(columns, axis=0) + 1e-300))
