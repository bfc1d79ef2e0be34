"""The offset that remains in an arm after a fault, kept for the next start.

If setpoints are the arm's only motion, a fault leaves it at its last setpoint: nominal joints plus
offset. The next start subtracts that offset; otherwise each arming would add another one.
"""

from __future__ import annotations

import hashlib
import mmap
import os
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from gapbridge.bridge.cell.runtime_folder import runtime_folder
from gapbridge.core.arrays import Array
from gapbridge.core.errors import InputError
from gapbridge.drivers.controller_address import address_of
from gapbridge.drivers.link_settings import DriverSettings

MOVED_AWAY = 0.02  # rad: an arm farther from its last setpoint has been moved meanwhile
RETURNED = 1e-6  # rad: an arm this near to the nominal joints was moved there, without the offset


class InForce(NamedTuple):
    """A joint offset (n,) rad and its TCP offset (6,) in base, m and rad."""

    delta: Array
    offset_in_base: Array


class OffsetInForce:
    """The setpoint sent last, kept in a file of the runtime folder that survives the process.

    Two records are written in turn, then the index of the valid one: if the process ends in
    between, the previous record stays valid. ``path`` None: kept in memory only.
    Raises InputError where the file cannot be used, as in a full folder.
    """

    def __init__(self, n: int, path: Path | None) -> None:
        self._n, size = n, 2 * n + 6
        count = 1 + 2 * size
        self._memory: mmap.mmap | bytearray
        if path is None:
            self._memory = bytearray(8 * count)
        else:
            try:
                self._memory = _mapped(path, 8 * count)
            except OSError as error:
                raise InputError(
                    f"{path}: the offset that remains in the arm cannot be kept: {error.strerror}"
                ) from None
        numbers = np.frombuffer(self._memory, np.float64)
        self._which = numbers[:1]  # 0: none; 1, 2: the valid record
        self._places = numbers[1:].reshape(2, size)
        self._before = float(self._which[0])
        self._arrived = False  # the arm was seen near the last setpoint

    @classmethod
    def of_link(cls, n: int, link: DriverSettings) -> Self:
        """Return the store for one controller. Raises InputError without a place for it."""
        key = hashlib.sha256(address_of(link).encode()).hexdigest()[:16]
        return cls(n, runtime_folder() / f"{key}.offset")

    def note(self, q: Array, delta: Array, offset_in_base: Array) -> None:
        """Store a sent setpoint: joints (n,) rad, their offset (n,), and its TCP offset (6,)."""
        place = 0 if self._which[0] == 2.0 else 1
        row, n = self._places[place], self._n
        row[:n], row[n : 2 * n], row[2 * n :] = q, delta, offset_in_base
        self._before = float(self._which[0])
        self._which[0] = place + 1.0
        self._arrived = False

    def take_back(self) -> None:
        """Return to what was stored before the last ``note``: it never took effect."""
        self._which[0] = self._before

    def follow(self, q: Array) -> None:
        """Forget the offset once an arm that nobody writes to leaves its last setpoint; q (n,) rad.

        An arm that comes back has been moved there without it. One that has not arrived yet, as
        drives may go on to their last setpoint, is not leaving.
        """
        if self._which[0] not in (1.0, 2.0):
            return
        near = bool((np.abs(self._record()[: self._n] - q) <= MOVED_AWAY).all())
        if self._arrived and not near:
            self._which[0] = self._before = 0.0
        self._arrived = near

    def offset_at(self, q: Array) -> InForce | None:
        """Return the offset that an arm at q (n,) rad still has; None: none, or it was moved."""
        if self._which[0] not in (1.0, 2.0):
            return None
        row, n = self._record(), self._n
        last, delta = row[:n], row[n : 2 * n]
        stayed = bool((np.abs(last - q) <= MOVED_AWAY).all()) and bool(np.isfinite(row).all())
        if not stayed or (np.abs(last - delta - q) <= RETURNED).all():
            return None
        return InForce(delta.copy(), row[2 * n :].copy())

    def _record(self) -> Array:
        """Return the valid record: last setpoint (n,), its joint offset (n,), TCP offset (6,)."""
        record: Array = self._places[int(self._which[0]) - 1]
        return record


def _mapped(path: Path, size: int) -> mmap.mmap:
    """Return a file of ``size`` bytes in memory. Raises OSError."""
    fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    try:
        if os.fstat(fd).st_size != size:  # new, or of another arm
            os.ftruncate(fd, 0)
            os.ftruncate(fd, size)
        if hasattr(os, "posix_fallocate"):
            # writing to a hole of a full folder would end the process by SIGBUS
            os.posix_fallocate(fd, 0, size)
        return mmap.mmap(fd, size)
    finally:
        os.close(fd)
