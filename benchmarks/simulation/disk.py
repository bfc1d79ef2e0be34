"""A disk that may be full, and that loses contents and names at a power cut: see LosingDisk."""

from __future__ import annotations

import contextlib
import errno
import os
import random
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.losing_disk import LosingDisk
from gapbridge.bridge.recording import segment


class Disk:
    """The folder of a run's recordings; only they are written there, from their begin on."""

    def __init__(self, draw: random.Random) -> None:
        self._draw = draw
        self._folder = tempfile.TemporaryDirectory(prefix="simulation-")
        self.folder = Path(self._folder.name) / "recordings"
        self.folder.mkdir()
        self.is_full = False
        self.losing = LosingDisk(self.folder)

    def cut_power(self) -> None:
        """Lose of files and of their names what was not synced: all of it, or as drawn."""
        self.losing.lose(self._draw)

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
        with disk.losing:
            yield
    finally:
        segment.os = before
        disk.remove()
