"""A side process takes a changed cell file, once the daemon reports that it has taken it."""

from __future__ import annotations

import hashlib
from typing import Any

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.run_settings import read_configuration
from gapbridge.core.errors import GapbridgeError

KEPT = ("web", "metrics", "recording", "model_source")  # belongs to this run's processes


class UpdatedSettings:
    """The settings that a run has by now, from those that it began with.

    ``text`` is the cell file that those were read from. The daemon's status reports a later file to
    a process that was started anew.
    """

    def __init__(self, settings: DaemonSettings, text: str | None) -> None:
        self.settings = settings
        self._hash = None if text is None else hashlib.sha256(text.encode()).hexdigest()

    def on_event(self, event: dict[str, Any]) -> bool:
        """Take note of an event; returns whether the settings are others now."""
        if event.get("kind") == "configuration" and event.get("ok"):
            reported = event.get("hash")
        elif event.get("kind") == "status":
            reported = event.get("configuration_hash")
        else:
            return False
        if not reported or reported == self._hash:
            return False
        first, self._hash = self._hash is None, str(reported)
        return not (first and event["kind"] == "status") and self._read(str(reported))

    def _read(self, reported: str) -> bool:
        """Read the file; one that has changed again meanwhile does not count."""
        try:
            found = read_configuration(self.settings.cell)
        except GapbridgeError:
            return False
        if found.hash != reported:
            return False
        kept = {name: getattr(self.settings, name) for name in KEPT}
        self.settings = found.settings.model_copy(update=kept)
        return True
