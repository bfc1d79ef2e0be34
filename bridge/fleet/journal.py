"""The journal: every outcome as it comes, so that an interrupted run is taken up again."""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path
from typing import Any, Self

from pydantic_core import from_json, to_json

from gapbridge.bridge.document.output_file import private, sync_folder
from gapbridge.bridge.fleet.task import Outcome
from gapbridge.core.errors import InputError, RunError

SYNC = 1.0  # s: what a crash of the machine, not of the program, may cost


class Journal:
    """An append-only file of JSON lines; one run at a time writes it."""

    def __init__(self, path: Path, *, fresh: bool = False) -> None:
        self.path = path
        self._synced = 0.0
        try:
            self._file = open(path, "a+b", opener=private)  # noqa: SIM115
            sync_folder(path.parent)
        except OSError as error:
            raise InputError(f"{path}: cannot be written: {error.strerror}") from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise RunError(f"{path}: another run writes it, expected one at a time") from None
        if fresh:
            self._file.truncate(0)
        self._known = self._read()

    def __enter__(self) -> Self:
        """Use it."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close it; what was added is on the disk."""
        os.fsync(self._file.fileno())
        self._file.close()

    def known(self, key: str) -> Outcome | None:
        """Return the outcome under a key, of an earlier run."""
        return self._known.get(key)

    def add(self, outcome: Outcome) -> None:
        """Write an outcome; it outlives the program at once, the machine after a second."""
        line = to_json(outcome.document())  # a ninth of json's time
        try:
            self._file.write(line + b"\n")
            self._file.flush()
            if time.monotonic() - self._synced > SYNC:
                os.fsync(self._file.fileno())
                self._synced = time.monotonic()
        except OSError as error:
            raise RunError(f"{self.path}: cannot be written: {error.strerror}") from None

    def _read(self) -> dict[str, Outcome]:
        """Return what earlier runs have left; a line that was cut off is taken away."""
        found: dict[str, Outcome] = {}
        self._file.seek(0)
        good = 0
        for line in self._file:
            if not line.endswith(b"\n"):
                break
            good += len(line)
            entry = _outcome(line)
            if entry is not None:
                found[entry.key] = entry
        self._file.truncate(good)
        return found


def _outcome(line: bytes) -> Outcome | None:
    try:
        given: dict[str, Any] = from_json(line)
        return Outcome(**given)
    except (ValueError, TypeError):
        return None
