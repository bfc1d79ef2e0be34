"""Connections of the hub: a socketcand client, or a serial line with an slcan adapter."""

from __future__ import annotations

import errno
import itertools
import math
import os
import socket
import termios
from abc import ABC, abstractmethod
from collections import deque

from gapbridge.drivers.clock import Clock
from gapbridge.drivers.simulated.can.frame import Frame

BACKLOG = 1 << 20  # unread bytes after which a client is disconnected
LONGEST = 200  # bytes of one message
QUIET = 0.02  # s after the handshake without a frame


class Port(ABC):
    """One connection: converts bytes to frames and back. Never blocks."""

    def __init__(self, fd: int) -> None:
        self.fd = fd
        self._out = bytearray()
        self._in = bytearray()

    @property
    def waiting(self) -> bool:
        """Return whether there are unsent bytes."""
        return bool(self._out)

    @abstractmethod
    def receive(self) -> list[Frame]:
        """Return the frames received. Raises OSError if the connection has ended."""

    @abstractmethod
    def deliver(self, frame: Frame, stamp: float) -> None:
        """Send one frame seen at ``stamp`` (s, wall clock). Raises OSError."""

    @abstractmethod
    def close(self) -> None:
        """Close the line."""

    def flush(self) -> None:
        """Write as many bytes as possible now. Raises OSError."""
        if self._out:
            try:
                written = os.write(self.fd, self._out)
            except BlockingIOError:
                return
            del self._out[:written]

    def _write(self, data: bytes) -> None:
        self._out += data
        self.flush()
        if len(self._out) > BACKLOG:
            raise OSError(errno.ENOBUFS, "a client does not read")

    def _read(self) -> None:
        data = os.read(self.fd, 65536)
        if not data:
            raise OSError(errno.ECONNRESET, "the client has left")
        self._in += data


class SocketcandPort(Port):
    """A client of the socketcand protocol: ``< open can0 >``, ``< rawmode >``, ``< send ... >``.

    The greeting and each answer leave in one piece of their own, and no frame follows the last one
    at once, as python-can expects.
    """

    def __init__(self, link: socket.socket, clock: Clock) -> None:
        super().__init__(link.fileno())
        self._now = clock.monotonic
        self._link = link
        self._frames_from = math.inf  # s, monotonic
        self._write(b"< hi >")

    def receive(self) -> list[Frame]:
        """Return the frames of all complete messages received."""
        self._read()
        frames: list[Frame] = []
        while (end := self._in.find(b">")) >= 0:
            text = bytes(self._in[:end]).decode("ascii", "replace")
            del self._in[: end + 1]
            self._execute(text.replace("<", " ").split(), frames)
        if len(self._in) > LONGEST:
            raise OSError(errno.EPROTO, "no end of a message")
        return frames

    def _execute(self, arguments: list[str], frames: list[Frame]) -> None:
        match arguments:
            case ["open", _]:
                self._write(b"< ok >")
            case ["rawmode"]:
                self._frames_from = self._now() + QUIET
                self._write(b"< ok >")
            case ["echo"]:
                self._write(b"< echo >")
            case ["send", identifier, length, *data]:
                frame = _parse_send(identifier, length, data)
                if frame is None:
                    self._write(b"< error could not parse send command >")
                else:
                    frames.append(frame)
            case _:
                self._write(b"< error unknown command >")

    def deliver(self, frame: Frame, stamp: float) -> None:
        """Send ``< frame id seconds.microseconds data >``."""
        if self._now() >= self._frames_from:
            name = f"{frame.id:08X}" if frame.extended else f"{frame.id:03X}"
            self._write(f"< frame {name} {stamp:.6f} {frame.data.hex().upper()} >".encode())

    def close(self) -> None:
        """Close the connection."""
        self._link.close()


def _parse_send(identifier: str, length: str, data: list[str]) -> Frame | None:
    try:
        content = bytes(int(byte, 16) for byte in data)
        if len(content) != int(length, 16):
            return None
        return Frame(int(identifier, 16), content, len(identifier) > 3)
    except ValueError:
        return None


class SerialPort(Port):
    """An slcan adapter on a pseudo-terminal (Lawicel's protocol): open, close, t and T frames."""

    def __init__(self, fd: int) -> None:
        super().__init__(fd)
        os.set_blocking(fd, False)
        mode = termios.tcgetattr(fd)
        mode[0] = mode[1] = mode[3] = 0  # no echo, no lines, no translation
        termios.tcsetattr(fd, termios.TCSANOW, mode)
        self._open = False

    def receive(self) -> list[Frame]:
        """Return the frames of all complete commands; each is answered by CR, or BEL."""
        self._read()
        frames: list[Frame] = []
        while (end := self._in.find(b"\r")) >= 0:
            text = bytes(self._in[:end]).decode("ascii", "replace").strip("\n")
            del self._in[: end + 1]
            self._execute(text, frames)
        if len(self._in) > LONGEST:
            self._in.clear()
        return frames

    def _execute(self, text: str, frames: list[Frame]) -> None:
        kind = text[:1]
        if kind in ("O", "L"):
            self._open = True
        elif kind == "C":
            self._open = False
        elif kind in ("t", "T"):
            frame = _parse_frame(text)
            if frame is None or not self._open:
                self._write(b"\a")
                return
            frames.append(frame)
            self._write(b"z\r" if kind == "t" else b"Z\r")
            return
        self._write({"V": b"V1013\r", "N": b"NGB01\r"}.get(kind, b"\r"))

    def deliver(self, frame: Frame, stamp: float) -> None:
        """Send the frame as ``tiiildd..`` or ``Tiiiiiiiildd..``."""
        if self._open:
            head = f"T{frame.id:08X}" if frame.extended else f"t{frame.id:03X}"
            self._write(f"{head}{len(frame.data)}{frame.data.hex().upper()}\r".encode())

    def close(self) -> None:
        """Close our end: the client sees a hang-up."""
        os.close(self.fd)


def _parse_frame(text: str) -> Frame | None:
    extended = text[0] == "T"
    head = 9 if extended else 4
    try:
        length = int(text[head : head + 1], 16)
        content = bytes.fromhex(text[head + 1 :])
        if len(content) != length:
            return None
        return Frame(int(text[1:head], 16), content, extended)
    except ValueError:
        return None


_numbers = itertools.count(2)


class InnerPort(Port):
    """A participant in the hub's process: frames are stored in a bounded queue.

    Its ``fd`` is a negative number, which is not a descriptor.
    """

    def __init__(self) -> None:
        super().__init__(-next(_numbers))
        self.frames: deque[Frame] = deque(maxlen=10_000)

    def receive(self) -> list[Frame]:
        """Return nothing: it has no connection."""
        return []

    def deliver(self, frame: Frame, stamp: float) -> None:
        """Store the frame."""
        self.frames.append(frame)

    def close(self) -> None:
        """Clear the queue."""
        self.frames.clear()
