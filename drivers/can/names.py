"""Names in a profile, looked up in its DBC; what is not there is reported with its line."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from gapbridge.drivers.can.dbc import Dbc
from gapbridge.drivers.can.profile import Key
from gapbridge.drivers.can.schema import ProfileFile
from gapbridge.drivers.profile_file import ProfileDocument, ProfileError

Keys = tuple[str | int, ...]


class Names:
    """One profile's keys and its DBC's messages."""

    def __init__(self, document: ProfileDocument, file: ProfileFile, dbc: Dbc) -> None:
        self.document, self.file, self.dbc = document, file, dbc

    def error(self, keys: Sequence[str | int], text: str) -> ProfileError:
        """Return the error that says ``words`` about a key of the profile."""
        return self.document.error(keys, text)

    def message(self, name: str, keys: Keys) -> tuple[Any, Key]:
        """Return a message (cantools) and its identifier. Raises ProfileError."""
        message = self.dbc.messages.get(name)
        if message is None:
            raise self.error(
                keys, f"found {name!r}, no message of {self.dbc.path.name}{self.dbc.nearest(name)}"
            )
        return message, (message.frame_id, message.is_extended_frame)

    def signal(self, name: str, keys: Keys) -> tuple[Any, Any]:
        """Return message and signal (cantools) of ``MESSAGE.SIGNAL``. Raises ProfileError."""
        message_name, _, signal_name = name.partition(".")
        message = self.dbc.messages.get(message_name)
        for signal in message.signals if message else ():
            if signal.name == signal_name:
                return message, signal
        raise self.error(
            keys, f"found {name!r}, no signal of {self.dbc.path.name}{self.dbc.nearest(name)}"
        )

    def key(self, identifier: int) -> Key:
        """Return an identifier with its length: 29 bits where the DBC or its value says so."""
        extended = identifier > 0x7FF or any(
            m.frame_id == identifier and m.is_extended_frame for m in self.dbc.messages.values()
        )
        return (identifier, extended)
