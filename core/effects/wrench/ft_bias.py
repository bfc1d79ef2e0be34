"""A constant error of the flange sensor."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import WRENCH_AXES, Effect, Parameter, Term

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.motion import Motion


class FtBias(Effect):
    """The flange sensor reads a constant too much: reading = wrench + bias, in flange axes.

    Comes from mounting strain, temperature, an old zero. Shows the same at every pose, while the
    weight of a payload turns with the flange: poses that turn the flange separate it from a
    payload, and from one pose it is not named; sessions of some length separate it from a drift.
    Source: Hollerbach, Khalil, Gautier, "Model Identification", Springer Handbook of
    Robotics (2016), ch. 6.
    """

    identifier = "ft_bias"
    title = "force sensor zero is off"
    label_template = "sensor zero of {part}"
    order = 80
    fits_any_constant = True
    replaces_cell_value = "sensor zero"
    channels = ("wrench",)
    motion = "poses that turn the flange by tens of degrees against gravity"
    simulator_advice = "subtract the bias from the sensor's readings"
    fixed_parameters = (
        *(Parameter(axis, "N", 1.0) for axis in WRENCH_AXES[:3]),
        *(Parameter(axis, "Nm", 0.1) for axis in WRENCH_AXES[3:]),
    )

    def sense(self, term: Term, arm: Arm, wrench: Array, motion: Motion) -> Array:
        """Add the constant."""
        import numpy as np

        return np.asarray(wrench + np.array(term.values))
