"""Events as a line of a log, for Foxglove's log panel (schema ``foxglove.Log``)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

LEVELS = {"info": 2, "warning": 3, "error": 4}  # foxglove.Log's own numbers
_PLAIN = ("time", "monotonic", "sequence", "kind", "cycle")


def level_of(event: Mapping[str, Any]) -> str:
    """Return how grave an event is."""
    if event.get("kind") == "fault" or event.get("to") == "FAULT":
        return "error"
    grave = event.get("kind") == "refused" or "paused" in event or "lost" in event
    return "warning" if grave or event.get("to") == "HOLDING" else "info"


def text_of(event: Mapping[str, Any]) -> str:
    """Return an event in words."""
    if "from" in event and "to" in event:
        text = f"{event['from']} -> {event['to']} ({event.get('cause', '')})"
        return f"{text}: {event['detail']}" if event.get("detail") else text
    if event.get("detail"):
        return str(event["detail"])
    parts = [f"{key} {value}" for key, value in event.items() if key not in _PLAIN]
    return f"{event.get('kind', '')}: {', '.join(parts)}"
