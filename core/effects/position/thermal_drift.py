"""Growth of the links with their temperature."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gapbridge.core.effects.effect import Effect, Parameter, Term

if TYPE_CHECKING:
    from gapbridge.core.arm import Arm
    from gapbridge.core.arrays import Array
    from gapbridge.core.kernels.reference import Rows
    from gapbridge.core.loads import Loads


class ThermalDrift(Effect):
    """The links grow with their joints' temperature: a and d of link i by alpha (T_i - reference).

    One coefficient of expansion for the arm; base, tool and centres of gravity do not grow. Needs
    joint temperatures that change over the session. Steel 12e-6, aluminium 23e-6 per kelvin.
    Source: VSB Ostrava 2021 on IRB1200 thermal drift.
    """

    identifier = "thermal_drift"
    title = "links grow as they warm up"
    label_template = "growth of link {joint} with warmth"
    adds_up = True
    channels = ("position",)
    needs = ("joint_temperatures",)
    motion = "joint temperatures that change by several degrees"
    simulator_advice = "scale the links' lengths for one temperature"
    fixed_parameters = (Parameter("", "1/K", 1e-5, 0.0, 1e-3),)  # coefficient of expansion

    def condition(self, term: Term, arm: Arm, rows: Rows, loads: Loads, q: Array) -> None:
        """Lengthen the links."""
        if loads.temperature is not None:
            rows.link_scale[:, :] += term.values[0] * loads.temperature
