"""Whether arming can come to anything: what the model makes of where the arm stands now."""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.compensation import Compensator
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

LEAST = 1e-9  # m, rad: a smaller offset is none
PULL = 10.0  # N: a model that bends under a pull corrects something
POSES, SEED = 16, 14  # tried beside the present one


class ModelCheck:
    """Says whether a model corrects anything at all; tries poses once, then remembers."""

    def __init__(self, model: Model, use_force: bool) -> None:
        self._compensator = Compensator(model)
        limits, n = model.arm.limits, model.arm.n
        lower, upper = np.maximum(limits.lower, -np.pi), np.minimum(limits.upper, np.pi)
        self._poses = np.random.default_rng(SEED).uniform(lower, upper, (POSES, n))
        self._use_force = use_force
        self._known: bool | None = None

    def corrects(self, loads: Loads) -> bool:
        """Return whether some pose gets an offset under these loads (one row), or under a pull."""
        if self._known is None:
            self._known = any(self._offset(q, loads) for q in self._poses)
        return self._known

    def forget(self) -> None:
        """Try anew the next time: the loads may be others."""
        self._known = None

    def _offset(self, q: Array, loads: Loads) -> bool:
        wrench = np.zeros((1, 6)) if loads.wrench is None else loads.wrench
        tried = [wrench]
        if self._use_force:
            pulls = np.zeros((3, 1, 6))
            pulls[range(3), 0, range(3)] = PULL
            tried += [wrench + pull for pull in pulls]
        for pull in tried:
            found = self._compensator.correct(
                q,
                Loads(
                    loads.payload_mass, loads.payload_cog, pull, loads.temperature, loads.approach
                ),
            )
            # what cannot be solved is not nothing: it is said where it happens
            if not found.residual < np.inf or np.abs(found.offset_in_base).max() > LEAST:
                return True
        return False
