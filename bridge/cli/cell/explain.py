"""``gapbridge explain``."""

from __future__ import annotations

import inspect
import os
from collections import Counter

import click

from gapbridge.core.effects import CATALOGUE, CHANNELS, Effect, effect_named, ties_of

ARM = "ur10e"  # has parallel axes, between which a link has one more parameter


@click.command()
@click.argument("effect", required=False)
def explain(effect: str | None) -> None:
    """Explain an effect of the catalogue: where it comes from, what shows it.

    Without EFFECT, lists them all.

    Example: gapbridge explain backlash
    """
    if effect is None:
        width = max(map(len, CATALOGUE))
        for name, member in CATALOGUE.items():
            first = _text(member).partition("\n")[0]
            click.echo(f"{name:<{width}}  {first}")
        return
    # starting numpy's threads would take longer than all the rest
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    click.echo(explanation_text(effect_named(effect)))


def explanation_text(effect: Effect) -> str:
    """Return the description, needed data and parameters of an effect."""
    from gapbridge.core.arm import builtin_arm  # slow to import, not needed by the list

    sites = effect.sites(builtin_arm(ARM))
    channels = ", ".join(f"{name} ({CHANNELS[name]})" for name in effect.channels)
    lines = [effect.identifier, "", _text(effect), "", f"shows in: {channels}"]
    if effect.motion:
        lines.append(f"needs motion: {effect.motion}")
    for other, data in ties_of(effect.identifier).items():
        lines.append(f"looks the same as {other} on: {data}")
    if effect.needs:
        lines.append(f"needs columns: {', '.join(effect.needs)}")
    lines.append("acts at: " + ("one joint each" if sites[0].joint else "the whole arm"))
    lines.append("parameters in a cell file:")
    lines += [f"  {name} ({unit})" for name, unit in parameter_texts(effect)]
    return "\n".join(lines)


def parameter_texts(effect: Effect) -> list[tuple[str, str]]:
    """Return name and unit of each parameter; the unit says where some joints do not have it."""
    from gapbridge.core.arm import builtin_arm

    arm = builtin_arm(ARM)
    sites = effect.sites(arm)
    found = [parameter for site in sites for parameter in effect.parameters(arm, site)]
    count = Counter(parameter.name for parameter in found)
    units = {parameter.name: parameter.unit or "no unit" for parameter in found}
    return [
        (name or "value", unit if count[name] == len(sites) else f"{unit}, not of every joint")
        for name, unit in units.items()
    ]


def _text(effect: Effect) -> str:
    """Return an effect's docstring without its markup."""
    return (inspect.getdoc(effect) or "").replace("``", "")
