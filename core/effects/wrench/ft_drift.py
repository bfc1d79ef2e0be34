"""A flange sensor whose zero runs away."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import WRENCH_AXES, Effect, Parameter, Term

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion


class FtDrift(Effect):
    """The zero of the flange sensor runs away evenly: reading = wrench + rate (t - first t).

    Comes from warming up. Zero at the first timestamp of the log: what is wrong there already is
    ``ft_bias``. Needs timestamps over minutes, and poses that come back in another order or
    several payloads, so that time and load do not change together.
    Source: data sheets of strain-gauge sensors, which give the zero's drift per kelvin.
    """

    identifier = "ft_drift"
    title = "force sensor zero drifts"
    order = 70
    channels = ("wrench",)
    needs = ("timestamp",)
    motion = "a session long enough for the zero to move, with poses that come back"
    simulator_advice = "subtract the drift from the sensor's readings"
    fixed_parameters = (
        *(Parameter(axis, "N/s", 1e-3) for axis in WRENCH_AXES[:3]),
        *(Parameter(axis, "Nm/s", 1e-4) for axis in WRENCH_AXES[3:]),
    )

    def sense(self, term: Term, arm: Arm, wrench: Array, motion: Motion) -> Array:
        """Add what has run up since the log's first row."""
        import numpy as np

        return wrench + np.outer(motion.t - motion.start, term.values)
