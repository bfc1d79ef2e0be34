"""Settings of a side process, updated when the daemon has loaded a changed cell file."""

from __future__ import annotations

import hashlib
from typing import Any

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.ipc.events import EventKind
from gapbridge.core.errors import GapbridgeError

FIXED_KEYS = ("web", "metrics", "recording", "model_source")  # until the daemon restarts


class UpdatedSettings:
    """The current settings of a run.

    ``text`` is the cell file from which the initial settings were read. A restarted side process
    learns of a later file from the daemon's status.
    """

    def __init__(self, settings: DaemonSettings, text: str | None) -> None:
        self.settings = settings
        self._hash = None if text is None else hashlib.sha256(text.encode()).hexdigest()

    def on_event(self, event: dict[str, Any]) -> bool:
        """Handle an event of the daemon; returns whether the settings changed."""
        if event.get("kind") == EventKind.CONFIGURATION and event.get("ok"):
            reported = event.get("hash")
        elif event.get("kind") == EventKind.STATUS:
            reported = event.get("configuration_hash")
        else:
            return False
        if not reported or reported == self._hash:
            return False
        first, self._hash = self._hash is None, str(reported)
        return not (first and event["kind"] == EventKind.STATUS) and self._read(str(reported))

    def _read(self, reported: str) -> bool:
        """Read the file; returns False if it is invalid or has changed again."""
        from gapbridge.bridge.cell.run_settings import read_configuration  # brings numba

        try:
            configuration = read_configuration(self.settings.cell)
        except GapbridgeError:
            return False
        if configuration.hash != reported:
            return False
        fixed = {name: getattr(self.settings, name) for name in FIXED_KEYS}
        self.settings = configuration.settings.model_copy(update=fixed)
        return True
