"""A disk that may be full, and that keeps after a power cut what was synced and nothing else."""

from __future__ import annotations

import contextlib
import errno
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from gapbridge.bridge.recording import segment


class Disk:
    """The folder of a run's recordings; only they are written there, from their begin on."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="simulation-")
        self.folder = Path(self._folder.name)
        self.is_full = False
        self._synced: dict[str, int] = {}  # bytes of each file

    def cut_power(self) -> None:
        """Lose what was not synced."""
        for path in self.folder.iterdir():
            os.truncate(path, min(self._synced.get(str(path), 0), path.stat().st_size))

    def remove(self) -> None:
        """Remove all files."""
        self._folder.cleanup()

    # -- what the recorder calls in place of the system -------------------------------------------

    def write(self, fd: int, data: Any) -> int:
        """Write; on a full disk the half at first, then nothing. Raises OSError."""
        if not self.is_full:
            return os.write(fd, data)
        if len(data) > 1:
            return os.write(fd, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def fsync(self, fd: int) -> None:
        """Note what is on the disk from now on. Raises OSError."""
        self._synced[os.readlink(f"/proc/self/fd/{fd}")] = os.fstat(fd).st_size

    fdatasync = fsync

    def __getattr__(self, name: str) -> Any:
        return getattr(os, name)


@contextlib.contextmanager
def recorded_on(disk: Disk | None) -> Iterator[None]:
    """Have segments be written to this disk while the ``with`` block lasts."""
    if disk is None:
        yield
        return
    before: Any = segment.os
    segment.os = disk  # type: ignore[assignment]
    try:
        yield
    finally:
        segment.os = before
        disk.remove()
