"""Whether an accused parameter is constant, or the mean of a function of some quantity.

Backlash that grows with the load looks like backlash, and a joint that is more compliant on one
side like a compliant joint: the effect is only the first order of the real one. So each accused
parameter may vary with every quantity of the log in turn, by an unnamed function. If this improves
the fit significantly and the variation is no small share of the mean, the effect is withdrawn.
A periodic line may vary between the quarters of its joint's range, because gears repeat in each.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import MAX_VARIATION
from gapbridge.core.diagnosis.selection.candidate import Candidate, joint_quantity
from gapbridge.core.diagnosis.selection.delay_columns import exact_columns
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.diagnosis.selection.smooth import spline_basis
from gapbridge.core.effects import Term
from gapbridge.core.estimation.least_squares import (
    basis_of,
    projected_out,
    solve,
    unit_columns,
)


def not_constant(
    selection: Selection, accused: Sequence[int], unnamed: Array | None = None
) -> dict[int, str]:
    """Return the accused candidates whose parameter varies, with the quantity it depends on.

    ``unnamed`` (m, d) are the columns of the unnamed functions fitted together with the accused, in
    the sample space. None: not known (on all rows); then only periodic lines are tested. Only poses
    are tested: in motion, friction and delay depend on a joint's speed anyway.
    """
    if selection.observation.channel != "position":
        return {}
    further = selection.working.X[:, :0] if unnamed is None else unnamed
    if selection.links is not None:
        further = selection.links.whitened(further)
    single, depends_on = [c for c in accused if c not in selection.block], {}
    for c in single:
        candidate = selection.working.candidates[c]
        if candidate.periodic or (unnamed is not None and _scales_a_quantity(candidate)):
            quantity, share = _variation(selection, c, single, further)
            if share > MAX_VARIATION:
                depends_on[c] = quantity
    return depends_on


def _scales_a_quantity(candidate: Candidate) -> bool:
    """Return whether an effect is one number times a physical quantity.

    Not so offsets (their mean is an offset whatever else is there), lines, curves and steps.
    """
    effect = candidate.effect
    form = (
        effect.estimated_with_links
        or effect.estimated_as_whole
        or effect.has_nonlinearity
        or effect.at_moment
    )
    return not (form or candidate.periodic)


def _variation(
    selection: Selection, c: int, accused: Sequence[int], unnamed: Array
) -> tuple[str, float]:
    """Return the quantity that a parameter depends on, and its variation (rms over the mean).

    ("", 0) where no variation improves the fit by more than its penalty for chance.
    """
    space, observation = selection.working, selection.observation
    jacobian = exact_columns(observation, space.candidates[c], _others(selection, c))
    constant = selection.rows_of(_by_session(jacobian, observation.quantities.get("session")))
    others = np.hstack([space.columns([o for o in accused if o != c]), unnamed])
    basis = basis_of(unit_columns(np.hstack([constant, others])))
    residual = projected_out(basis, space.y)
    freedom = max(space.freedom - basis.shape[1], 1.0)
    variance = max(float(residual @ residual) / freedom, space.floor)
    shapes = _shapes(selection, space.candidates[c])
    best, name, varying = 0.0, "", constant[:, :0]
    for quantity, shape in shapes.items():
        columns = jacobian[:, :, :, None] * shape[:, None, None, :]
        rows = unit_columns(selection.rows_of(columns.reshape(*jacobian.shape[:2], -1)))
        further = basis_of(projected_out(basis, rows))
        gain = float(np.sum((further.T @ residual) ** 2)) / variance
        gain -= further.shape[1] * np.log(space.freedom) + 2 * np.log(len(shapes))
        if gain > best:
            best, name, varying = gain, quantity, rows
    if not name:
        return "", 0.0
    both = np.hstack([constant, varying])
    A = np.hstack([both, others])
    x = solve(A, space.y)
    whole = both @ x[: both.shape[1]]
    mean = constant @ solve(constant, whole)
    share = float(np.linalg.norm(whole - mean) / max(float(np.linalg.norm(mean)), 1e-300))
    return name, share


def _by_session(columns: Array, session: Array | None) -> Array:
    """Return columns (N, k, d) with one parameter per session: a change is no variation."""
    if session is None:
        return columns
    each = (session[:, None] == np.unique(session)).astype(float)
    split = columns[:, :, :, None] * each[:, None, None, :]
    return np.asarray(split.reshape(*columns.shape[:2], -1))


def _others(selection: Selection, c: int) -> list[Term]:
    return [t for o, t in zip(selection.term_index, selection.terms, strict=True) if o != c]


def _shapes(selection: Selection, candidate: Candidate) -> dict[str, Array]:
    """Return, by quantity, the functions (N, d) of it by which a parameter may vary."""
    quantities = _quantities(selection, candidate)
    if not candidate.periodic:
        return {name: spline_basis(z) for name, z in quantities.items()}
    assert candidate.site.joint is not None
    angle = joint_quantity(selection.observation, candidate.site.joint - 1)
    return {angle: _quarters(quantities[angle])} if angle in quantities else {}


def _quarters(z: Array) -> Array:
    """Return centred indicators (N, 3) of the quarter of a quantity's range of each sample."""
    quarter = np.searchsorted(np.quantile(z, (0.25, 0.5, 0.75)), z)
    indicators = (quarter[:, None] == np.arange(1, 4)).astype(float)
    return np.asarray(indicators - indicators.mean(axis=0))


def _quantities(selection: Selection, candidate: Candidate) -> dict[str, Array]:
    """Return what a parameter may depend on: columns of the log, and its joint's static load.

    Not the session, nor the time where there are several: session_transfer reports such changes.
    """
    observation, joint = selection.observation, candidate.site.joint
    quantities = dict(observation.quantities)
    if "session" in quantities:
        del quantities["session"]
        quantities.pop("timestamp", None)
    if observation.axial_moment is not None and joint is not None:
        quantities["load"] = np.abs(observation.axial_moment[:, joint - 1])
    return {name: z for name, z in quantities.items() if len(np.unique(z)) > 2}
