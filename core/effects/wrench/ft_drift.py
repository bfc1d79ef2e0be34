"""A flange sensor whose zero runs away."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import Effect, Parameter, Site, Term

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion


AXES = ("fx", "fy", "fz", "mx", "my", "mz")


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

    def parameters(self, arm: Arm, site: Site) -> tuple[Parameter, ...]:
        """Return the rates along the flange axes."""
        units = ("N/s",) * 3 + ("Nm/s",) * 3
        scales = (1e-3,) * 3 + (1e-4,) * 3
        return tuple(Parameter(*p) for p in zip(AXES, units, scales, strict=True))

    def sense(self, term: Term, arm: Arm, wrench: Array, motion: Motion) -> Array:
        """Add what has run up since the log's first row."""
        import numpy as np

        return wrench + np.outer(motion.t - motion.start, term.values)
