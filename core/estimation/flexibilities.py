"""The flexibilities of a model as a vector, and their prior before any measurement."""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.effects.effect import typical_moment
from gapbridge.core.model import Model


def flexibilities(model: Model) -> Array:
    """Return the model's linear flexibilities (2n,) rad/Nm: axial, then radial.

    Those that ``with_compliance`` replaces; nonlinear stiffness terms are not included.
    """
    values = np.zeros(2 * model.arm.n)
    for term in model.terms:
        kind = CATALOGUE[term.effect].flexibility
        if kind and term.site.joint:
            first = 0 if kind == "axial" else model.arm.n
            values[first + term.site.joint - 1] += term.values[0]
    return values


def typical_flexibility(model: Model) -> float:
    """Return a usual flexibility (rad/Nm) of a joint of an arm of this size."""
    return 1e-3 / typical_moment(model.arm)


def prior_of(model: Model) -> tuple[Array, float]:
    """Return mean (2n,) and 1 sigma, rad/Nm, of the weak prior of the flexibilities."""
    return flexibilities(model), 10 * typical_flexibility(model)
