"""Data exchange between the loop and its Modbus server, in shared memory without locks."""

from __future__ import annotations

import mmap
import os
import struct

import numpy as np

from gapbridge.bridge.ipc.sealed_memory import is_sealed, make_memory, map_as_reader, map_as_writer
from gapbridge.core.arrays import Array

MOST_JOINTS = 10
_HEAD = struct.Struct("<qqqqq")
_SIZE = 512  # bytes of one record
ATTEMPTS = 100


class Record:
    """The newest numbers in one direction, read consistently; sealed by its writer.

    The first word is a version, which is odd during a write (a sequence lock).
    """

    def __init__(self, fd: int, writes: bool) -> None:
        self.fd = fd
        self._map: mmap.mmap = (map_as_writer if writes else map_as_reader)(fd, _SIZE)

    def write(self, words: tuple[int, int, int, int], values: Array) -> None:
        """Replace the record."""
        version = _HEAD.unpack_from(self._map)[0]
        struct.pack_into("<q", self._map, 0, version + 1)
        data = values.astype("<f8").tobytes()
        self._map[_HEAD.size : _HEAD.size + len(data)] = data
        _HEAD.pack_into(self._map, 0, version + 1, *words)
        struct.pack_into("<q", self._map, 0, version + 2)

    def read(self, count: int) -> tuple[tuple[int, ...], Array] | None:
        """Return words and numbers, or None if each attempt met a write."""
        for _ in range(ATTEMPTS):
            version, *words = _HEAD.unpack_from(self._map)
            values = np.frombuffer(self._map, "<f8", count, _HEAD.size).copy()
            if version % 2 == 0 and version == struct.unpack_from("<q", self._map)[0]:
                return tuple(words), values
        return None

    def close(self) -> None:
        """Unmap and close the memory."""
        self._map.close()
        os.close(self.fd)


class PlcMemory:
    """Two records, one a direction: each side writes its own and only reads the other's.

    Without descriptors it is the loop's side, which creates both; with both (setpoint, status) it
    is the server's.
    """

    def __init__(self, n: int, fds: tuple[int, int] | None = None) -> None:
        self.n = n
        is_server = fds is not None
        if fds is None:
            fds = make_memory("gapbridge-plc", _SIZE), make_memory("gapbridge-answers", _SIZE)
        self._setpoint = Record(fds[0], writes=is_server)
        self._status = Record(fds[1], writes=not is_server)

    @property
    def fds(self) -> tuple[int, int]:
        """Return the descriptors of setpoint and status, for the server."""
        return self._setpoint.fd, self._status.fd

    @property
    def is_sealed(self) -> bool:
        """Return whether only its own side can write to each."""
        return all(map(is_sealed, self.fds))

    # -- from the PLC -----------------------------------------------------------------------------

    def put_setpoint(self, sequence: int, q: Array) -> None:
        """Pass a setpoint (n,) rad to the loop."""
        self._setpoint.write((sequence, 1, 0, 0), q)

    def setpoint(self) -> tuple[int, Array] | None:
        """Return sequence number and joints (n,) rad; None if there are none yet."""
        record = self._setpoint.read(self.n)
        if record is None or not record[0][1]:
            return None
        return record[0][0], record[1]

    # -- to the PLC -------------------------------------------------------------------------------

    def put_status(self, words: tuple[int, int, int, int], values: Array) -> None:
        """Report state, sequence accepted, cycle, flags; corrected, nominal (n,), offset (6,)."""
        self._status.write(words, values)

    def status(self) -> tuple[tuple[int, ...], Array] | None:
        """Return what ``put_status`` has reported last."""
        return self._status.read(2 * self.n + 6)

    def close(self) -> None:
        """Unmap and close the memory."""
        self._setpoint.close()
        self._status.close()
