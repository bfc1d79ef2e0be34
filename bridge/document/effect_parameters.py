"""The parameters of an effect at all of its sites, as ``explain`` and the catalogue list them."""

from __future__ import annotations

from collections import Counter

from gapbridge.core.arm import builtin_arm
from gapbridge.core.effects import Effect

ARM = "ur10e"  # has parallel axes, between which a link has one more parameter


def parameter_texts(effect: Effect) -> list[tuple[str, str]]:
    """Return name and unit of each parameter; the unit says where some joints do not have it."""
    arm = builtin_arm(ARM)
    sites = effect.sites(arm)
    found = [parameter for site in sites for parameter in effect.parameters(arm, site)]
    count = Counter(parameter.name for parameter in found)
    units = {parameter.name: parameter.unit or "no unit" for parameter in found}
    return [
        (name or "value", unit if count[name] == len(sites) else f"{unit}, not of every joint")
        for name, unit in units.items()
    ]
