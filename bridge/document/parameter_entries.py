"""Parameters of causes as the JSON of a diagnosis and the provenance of a cell list them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from gapbridge.bridge.document.json_text import finite
from gapbridge.core.effects import Reported


def parameter_entries(parameters: Iterable[Reported]) -> list[dict[str, Any]]:
    """Return name, value, standard deviation and unit of each parameter; unknown ones are None.

    Where the sessions' clocks overlap, a moment has no value, and the first session after it
    follows.
    """
    entries: list[dict[str, Any]] = []
    for p in parameters:
        entries.append(
            {"name": p.name, "value": finite(p.value), "std": finite(p.std), "unit": p.unit}
        )
        if p.session:
            name = session_parameter(p)
            entries.append({"name": name, "value": p.session, "std": None, "unit": ""})
    return entries


def session_parameter(moment: Reported) -> str:
    """Return the name under which the first session after a moment is listed."""
    return moment.name.removesuffix("_time") + "_session"
