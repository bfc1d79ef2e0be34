"""Where one message ends and the next begins, per protocol."""

from __future__ import annotations

from abc import ABC, abstractmethod


class Splitter(ABC):
    """Cuts one direction of one stream into whole messages."""

    def __init__(self) -> None:
        self._rest = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Return the messages that are whole now."""
        self._rest += data
        found = []
        while (size := self._size(self._rest)) and len(self._rest) >= size:
            found.append(bytes(self._rest[:size]))
            del self._rest[:size]
        return found

    @abstractmethod
    def _size(self, rest: bytearray) -> int:
        """Return the size of the first message, 0 where it is not known yet."""


class Raw(Splitter):
    """Whatever comes, as it comes."""

    def _size(self, rest: bytearray) -> int:
        return len(rest)


class RtdeFrames(Splitter):
    """RTDE: a size of two bytes, a type, a payload."""

    def _size(self, rest: bytearray) -> int:
        return max(int.from_bytes(rest[:2], "big"), 3) if len(rest) >= 3 else 0


class ModbusFrames(Splitter):
    """Modbus TCP: six bytes of header, the last two the length of the rest."""

    def _size(self, rest: bytearray) -> int:
        return 6 + int.from_bytes(rest[4:6], "big") if len(rest) >= 6 else 0


class SocketcandMessages(Splitter):
    """The socketcand protocol: each message ends with ``>``."""

    def _size(self, rest: bytearray) -> int:
        return rest.find(b">") + 1
