"""The journal of a session: an append-only file of JSON lines, synced to disk line by line.

A power failure can tear the last line only; it is removed when the session is resumed.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import time
from pathlib import Path
from typing import Any, Self

import numpy as np

from gapbridge.bridge.document.output_file import MODE, make_folder, sync_folder
from gapbridge.core.errors import InputError, RunError

FILE = "journal.jsonl"
VERSION = 1

Entry = dict[str, Any]


class Journal:
    """The only writer of a session's journal; ``entries`` are those found when it was opened."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE
        self.entries: list[Entry] = []
        self.torn = False  # the last line was incomplete and has been removed
        self._fd = -1
        self._made: list[Path] = []  # folders, the inner one first

    def open(self) -> None:
        """Lock the journal and read its entries.

        Raises InputError if it cannot be written, another process has locked it, or a line is
        damaged.
        """
        try:
            folder = self.path.parent
            self._made = [one for one in (folder, folder.parent) if not one.exists()]
            make_folder(self.path.parent)
            self._fd = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, MODE)
            sync_folder(self.path.parent)
        except OSError as error:
            raise InputError(f"{self.path}: cannot be written: {error.strerror}") from None
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self.close()
            raise InputError(
                f"{self.path}: found a session that is open in another terminal, expected none"
            ) from None
        self._read()

    def _read(self) -> None:
        text = self.path.read_bytes()
        whole = text.rfind(b"\n") + 1
        if whole < len(text):
            os.ftruncate(self._fd, whole)
            os.fsync(self._fd)
            self.torn = True
        self.entries = read_entries(self.path)

    def add(self, kind: str, **fields: Any) -> Entry:
        """Append an entry, sync it to disk and return it.

        Raises RunError if that fails; the journal is then unchanged.
        """
        entry = {"kind": kind, "time": time.time(), **fields}
        line = json.dumps(plain(entry), allow_nan=False, separators=(",", ":")) + "\n"
        end = os.fstat(self._fd).st_size
        try:
            data = line.encode()
            if os.write(self._fd, data) != len(data):
                raise OSError(0, "the disk is full")
            os.fsync(self._fd)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, end)
            raise RunError(f"{self.path}: cannot be written: {error.strerror}") from None
        return entry

    def discard(self) -> None:
        """Remove the file, and the folders that ``open`` made and nothing else is in."""
        with contextlib.suppress(OSError):
            self.path.unlink()
            for folder in self._made:
                folder.rmdir()

    def close(self) -> None:
        """Close and unlock the file. May be repeated."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def read_entries(path: Path) -> list[Entry]:
    """Return the entries of all complete lines; raises InputError if one is damaged."""
    try:
        lines = path.read_bytes().split(b"\n")[:-1]
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    entries = []
    for number, line in enumerate(lines, 1):
        try:
            entry = json.loads(line)
            if not isinstance(entry, dict) or not isinstance(entry.get("kind"), str):
                raise ValueError
        except ValueError:
            raise InputError(
                f"{path}: row {number}: found {line[:40].decode('utf-8', 'replace')!r}, expected "
                "an entry of a calibration session"
            ) from None
        entries.append(entry)
    return entries


def plain(value: Any) -> Any:
    """Return a value for JSON: arrays as lists, nan and inf as strings that ``float`` accepts."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(v) for v in (value.tolist() if isinstance(value, np.ndarray) else value)]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    return str(value) if isinstance(value, Path) else value
