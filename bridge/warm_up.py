"""Compile the inner loops: ``python -m bridge.warm_up``, once per installation.

Numba keeps what it has compiled beside the sources. Without this, the first command of a new
installation spends half a minute on it, in the middle of its work.
"""

from __future__ import annotations

import numpy as np

from core.arm import builtin_arm
from core.compensation import correct
from core.model import Model


def warm_up() -> None:
    """Call each compiled function once."""
    n = 6
    model = Model(builtin_arm("ur10e")).with_compliance(np.full(n, 1e-6), np.full(n, 1e-6))
    q = np.array([[0.0, -1.5, 1.8, -1.87, -1.57, 0.0]])
    model.predict(q)
    model.linear_form(q)
    correct(model, q)


if __name__ == "__main__":
    warm_up()
