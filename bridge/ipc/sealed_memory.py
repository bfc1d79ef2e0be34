"""Memory that only one process can write to: no other can, by a descriptor or through /proc.

A descriptor opened for reading is no protection: its owner can open the same memory for writing
through ``/proc/self/fd``. So the writer maps its memory first and then seals it
(``F_SEAL_FUTURE_WRITE``, memfd_create(2)): its own mapping stays writable, and every later one, in
any process, is for reading only. Without seals (not Linux) only modes protect.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import tempfile

_FUTURE_WRITE = getattr(fcntl, "F_SEAL_FUTURE_WRITE", 0x0010)  # linux/fcntl.h
HAS_SEALS = hasattr(os, "memfd_create") and hasattr(fcntl, "F_ADD_SEALS")


def make_memory(name: str, size: int) -> int:
    """Return the descriptor of ``size`` zeroed bytes of anonymous memory, not sealed yet."""
    if HAS_SEALS:
        fd = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    else:
        with tempfile.TemporaryFile() as file:
            fd = os.dup(file.fileno())
    os.ftruncate(fd, size)
    return fd


def map_as_writer(fd: int, size: int) -> mmap.mmap:
    """Return the memory mapped for writing, and seal it against further such mappings.

    Raises OSError if it is sealed already.
    """
    memory = mmap.mmap(fd, size, access=mmap.ACCESS_WRITE)
    seal(fd)
    return memory


def map_as_reader(fd: int, size: int) -> mmap.mmap:
    """Return the memory mapped for reading."""
    return mmap.mmap(fd, size, access=mmap.ACCESS_READ)


def seal(fd: int) -> None:
    """Forbid new writable mappings, resizing, and removing the seals."""
    if HAS_SEALS:
        every = fcntl.F_SEAL_GROW | fcntl.F_SEAL_SHRINK | _FUTURE_WRITE | fcntl.F_SEAL_SEAL
        fcntl.fcntl(fd, fcntl.F_ADD_SEALS, every)


def sealed_bytes(name: str, data: bytes) -> int:
    """Return the descriptor of sealed memory that holds ``data``."""
    fd = make_memory(name, len(data))
    remaining, offset = memoryview(data), 0
    while remaining:
        done = os.pwrite(fd, remaining, offset)
        remaining, offset = remaining[done:], offset + done
    seal(fd)
    return fd


def all_bytes(fd: int) -> bytes:
    """Return the data of ``sealed_bytes``, and close the descriptor."""
    with os.fdopen(fd, "rb") as file:
        file.seek(0)
        return file.read()


def is_sealed(fd: int) -> bool:
    """Return whether no new writable mapping is possible."""
    if not HAS_SEALS:
        return True
    seals = fcntl.fcntl(fd, fcntl.F_GET_SEALS)
    return bool(seals & _FUTURE_WRITE) and bool(seals & fcntl.F_SEAL_SEAL)
