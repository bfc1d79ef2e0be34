"""The daemon's commands to its loop, through memory that only the daemon can write to.

One word for each command holds the number of its last request; numbers only grow, over all
processes of the loop. So no command overwrites another and none has to be cleared: the loop
compares each word with the last number it has received, and reports that number
(SharedMemory.note_taken). A STOP stays in force until its process of the loop has ended. One more
word is the daemon's heartbeat: a loop without it can be stopped by nobody.
"""

from __future__ import annotations

import os
import sys
import threading
from enum import IntEnum

import numpy as np

from gapbridge.bridge.ipc.sealed_memory import make_memory, map_as_reader, map_as_writer

_SIZE, _WORD = 4096, 8  # bytes


class Command(IntEnum):
    """A command of the daemon."""

    ARM = 1  # a person's, or the cell file's at the start
    DISARM = 2  # a person's: ramp out and observe; in a fault, acknowledge it
    RAMP_OUT = 3  # ramp out and observe; acknowledges nothing
    STOP = 4  # ramp out and end
    ZERO_MOVED = 5  # ramp out, observe, and refuse to arm until a person sends a later DISARM


_BEATS = 1 + max(Command)  # word of the heartbeat


class CommandMemory:
    """The daemon's side: numbers requests and writes them. From any of its threads."""

    def __init__(self) -> None:
        self.fd = make_memory("gapbridge-commands", _SIZE)
        self._map = map_as_writer(self.fd, _SIZE)
        self._words = np.frombuffer(self._map, np.int64)
        self._lock = threading.Lock()
        self.last = 0  # number of the last request, written or about to be

    def number(self) -> int:
        """Return the number of a request that is about to be written."""
        with self._lock:
            self.last += 1
            return self.last

    def ask(self, command: Command, number: int = 0) -> int:
        """Write a request under its number, or a new one; returns the number."""
        number = number or self.number()
        with self._lock:
            self._words[command] = max(number, int(self._words[command]))
        return number

    def last_of(self, command: Command) -> int:
        """Return the number of the last request written for a command; 0: none."""
        return int(self._words[command])

    def beat(self) -> None:
        """Report that requests are being passed on."""
        self._words[_BEATS] += 1

    def close(self) -> None:
        """Unmap and close the memory."""
        self._words = np.zeros(1 + _BEATS, np.int64)
        self._map.close()
        os.close(self.fd)


class Commands:
    """The loop's side: receives new requests, with numbers above ``after``."""

    def __init__(self, fd: int, after: int = 0) -> None:
        self._map = map_as_reader(fd, _SIZE)
        self._last_words = b""
        self._taken_numbers = dict.fromkeys(Command, after)
        self.last_taken = after  # number of the newest request received
        self.stop = False  # STOP was received

    def number_of(self, command: Command) -> int:
        """Return the number of the last request received for a command, ``after`` before it."""
        return self._taken_numbers[command]

    @property
    def beats(self) -> int:
        """Return the daemon's heartbeats so far; 0 before the first."""
        return int.from_bytes(self._map[_WORD * _BEATS :][:_WORD], sys.byteorder)

    def take(self) -> list[Command]:
        """Return the commands since the last call, in the order of their requests.

        An ARM older than a request received before is dropped: the later request wins.
        """
        words = self._map[: _WORD * _BEATS]
        if words == self._last_words:
            return []
        self._last_words = words
        numbers = [int.from_bytes(words[_WORD * c :][:_WORD], sys.byteorder) for c in Command]
        commands = []
        for number, command in sorted(zip(numbers, Command, strict=True)):
            if number <= self._taken_numbers[command]:
                continue
            self._taken_numbers[command] = number
            if command == Command.ARM and number < self.last_taken:
                continue
            self.last_taken = max(self.last_taken, number)
            self.stop |= command == Command.STOP
            commands.append(command)
        return commands
