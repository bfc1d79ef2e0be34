"""Scale errors of the flange sensor."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import WRENCH_AXES, Effect, Parameter, Site, Term

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion


class FtGain(Effect):
    """Each axis of the flange sensor is scaled: reading = (1 + gain) wrench, axis by axis.

    Comes from a wrong calibration matrix, an amplifier, an overload. An axis whose wrench stays
    zero contains nothing about its gain. With one payload for the whole log, six equal gains are
    the same as another payload; other payloads or pulls separate them.
    Source: Hollerbach, Khalil, Gautier, "Model Identification", Springer Handbook of
    Robotics (2016), ch. 6.
    """

    identifier = "ft_gain"
    title = "force sensor scale is off"
    order = 60
    scales_reading = True
    identifiable_with = Term("payload", Site(), (1.0,))
    channels = ("wrench",)
    motion = "a load on every axis: the flange turned every way, with pulls or several payloads"
    simulator_advice = "divide the sensor's readings by 1 + gain"
    fixed_parameters = tuple(Parameter(axis, "", 0.02, -0.95, 10.0) for axis in WRENCH_AXES)

    def sense(self, term: Term, arm: Arm, wrench: Array, motion: Motion) -> Array:
        """Scale the axes."""
        import numpy as np

        return wrench * (1.0 + np.array(term.values))
