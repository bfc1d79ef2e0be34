"""Structured logs: each of the daemon's events as one line of JSON (``run --log json``).

Fields that every line has: ``time`` (ISO 8601, UTC), ``level``, ``event`` (its kind), ``message``.
The other fields of an event follow under their own names, without the cell's text, keys or tokens:
see HIDDEN.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import IO, Any

from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.loop_state import State

HIDDEN = re.compile(
    r"token|password|secret|passwd|api_?key|private|credential|^key$", re.IGNORECASE
)
LEFT_OUT = ("text", "monotonic", "kind", "time", "detail")  # text: the whole cell file
LONGEST = 2000  # characters of one value
_ERRORS = (EventKind.FAULT, EventKind.REFUSED, EventKind.FAILURE, EventKind.SLIP)
_WARNINGS = (
    EventKind.SIDE, EventKind.WARNING, EventKind.DEGRADED, EventKind.DROPPED, EventKind.LINK,
)  # fmt: skip


def log_line(event: Mapping[str, Any]) -> str:
    """Return an event as one line of JSON, without the newline."""
    time = datetime.fromtimestamp(float(event.get("time", 0.0)), UTC)
    line: dict[str, Any] = {
        "time": time.isoformat(timespec="milliseconds").replace("+00:00", "Z"),
        "level": _level(event),
        "event": str(event.get("kind", EventKind.NOTE)),
        "message": _message(event),
    }
    for key, value in event.items():
        if key not in LEFT_OUT:
            line.setdefault(key, _shown(key, value))
    return json.dumps(line, ensure_ascii=True, default=str)


class JsonLines:
    """Writes events to a stream, usually stderr; ignores a closed or full stream."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def emit(self, event: Mapping[str, Any]) -> None:
        """Write one event."""
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(log_line(event) + "\n")
            self._stream.flush()


def _level(event: Mapping[str, Any]) -> str:
    if event.get("kind") in _ERRORS or "failure" in event or event.get("holds") is False:
        return "error"
    if str(event.get("to", "")).upper() == State.FAULT.name:
        return "error"
    if event.get("kind") == EventKind.DEGRADED and event.get("what") == "":  # it has ended
        return "info"
    if event.get("kind") in _WARNINGS or "paused" in event or "lost" in event:
        return "warning"
    return "info"


def _message(event: Mapping[str, Any]) -> str:
    if "to" in event:
        message = f"{event.get('from', '')} -> {event['to']} ({event.get('cause', '')})".lower()
        return f"{message}: {event['detail']}" if event.get("detail") else message
    for key in ("detail", "failure", "fault", "ended"):
        if event.get(key):
            return str(event[key])[:LONGEST]
    return str(event.get("kind", EventKind.NOTE))


def _shown(key: str, value: Any) -> Any:
    """Return a value without secrets, at any depth, and with strings cut to LONGEST."""
    if HIDDEN.search(key) and not isinstance(value, bool):
        return "(hidden)"
    if isinstance(value, Mapping):
        return {str(k): _shown(str(k), v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_shown("", v) for v in value]
    return value[:LONGEST] if isinstance(value, str) else value
