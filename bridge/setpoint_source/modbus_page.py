"""What the loop and its Modbus server tell each other, through memory that neither waits for."""

from __future__ import annotations

import mmap
import os
import struct
import tempfile

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]
MOST_JOINTS = 10
_HEAD = struct.Struct("<qqqqq")
_HALF = 512  # bytes of one direction
ATTEMPTS = 100


class PlcPage:
    """Two records, one a direction, each whole or not seen.

    A record's first word is a version: odd while it is being written.
    """

    def __init__(self, n: int, fd: int | None = None) -> None:
        self.n = n
        self.fd = _anonymous(2 * _HALF) if fd is None else fd
        self._map = mmap.mmap(self.fd, 2 * _HALF)

    def _write(self, at: int, words: tuple[int, int, int, int], values: Vector) -> None:
        version = _HEAD.unpack_from(self._map, at)[0]
        struct.pack_into("<q", self._map, at, version + 1)
        data = values.astype("<f8").tobytes()
        self._map[at + _HEAD.size : at + _HEAD.size + len(data)] = data
        _HEAD.pack_into(self._map, at, version + 1, *words)
        struct.pack_into("<q", self._map, at, version + 2)

    def _read(self, at: int, count: int) -> tuple[tuple[int, ...], Vector] | None:
        """Return words and numbers, or None where they are being written all the while."""
        for _ in range(ATTEMPTS):
            version, *words = _HEAD.unpack_from(self._map, at)
            values = np.frombuffer(self._map, "<f8", count, at + _HEAD.size).copy()
            if version % 2 == 0 and version == struct.unpack_from("<q", self._map, at)[0]:
                return tuple(words), values
        return None

    # -- from the PLC -----------------------------------------------------------------------------

    def put_setpoint(self, sequence: int, q: Vector) -> None:
        """Hand a setpoint (n,) rad to the loop."""
        self._write(0, (sequence, 1, 0, 0), q)

    def setpoint(self) -> tuple[int, Vector] | None:
        """Return sequence number and joints (n,) rad; None where there are none yet."""
        found = self._read(0, self.n)
        if found is None or not found[0][1]:
            return None
        return found[0][0], found[1]

    # -- to the PLC -------------------------------------------------------------------------------

    def put_status(self, words: tuple[int, int, int, int], values: Vector) -> None:
        """Tell state, sequence taken, cycle and flags; corrected, nominal (n,), offset (6,)."""
        self._write(_HALF, words, values)

    def status(self) -> tuple[tuple[int, ...], Vector] | None:
        """Return what ``put_status`` has told last."""
        return self._read(_HALF, 2 * self.n + 6)

    def close(self) -> None:
        """Let go of the memory."""
        self._map.close()
        os.close(self.fd)


def _anonymous(size: int) -> int:
    """Return the descriptor of zeroed memory that no name leads to."""
    if hasattr(os, "memfd_create"):
        fd = os.memfd_create("gapbridge-plc", os.MFD_CLOEXEC)
    else:
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
    os.ftruncate(fd, size)
    return fd
