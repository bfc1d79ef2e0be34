"""The journal of outcomes, from which an interrupted run is resumed."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import Any, Self

from pydantic_core import from_json, to_json

from gapbridge.bridge.document.output_file import private, sync_folder
from gapbridge.bridge.fleet.task import Outcome
from gapbridge.core.errors import InputError, RunError
from gapbridge.drivers.clock import Clock

SYNC_PERIOD = 1.0  # s of outcomes that a power failure may lose


class Journal:
    """An append-only file of JSON lines with one writer at a time."""

    def __init__(self, path: Path, clock: Clock, *, fresh: bool = False) -> None:
        self._now = clock.monotonic
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
        """Return the journal."""
        return self

    def __exit__(self, *_: object) -> None:
        """Sync it to disk and close it. Raises RunError where that fails."""
        try:
            with self._file:
                os.fsync(self._file.fileno())
        except OSError as error:
            raise self._unwritten(error) from None

    def known(self, key: str) -> Outcome | None:
        """Return the outcome of a task in an earlier run; None: there is none."""
        return self._known.get(key)

    def add(self, outcome: Outcome) -> None:
        """Write an outcome: flushed at once, synced to disk every SYNC_PERIOD."""
        line = to_json(outcome.document())  # nine times faster than json
        try:
            self._file.write(line + b"\n")
            self._file.flush()
            if self._now() - self._synced > SYNC_PERIOD:
                os.fsync(self._file.fileno())
                self._synced = self._now()
        except OSError as error:
            raise self._unwritten(error) from None

    def _unwritten(self, error: OSError) -> RunError:
        return RunError(f"{self.path}: cannot be written: {error.strerror}")

    def _read(self) -> dict[str, Outcome]:
        """Return the outcomes of earlier runs by key; an incomplete last line is removed."""
        outcomes: dict[str, Outcome] = {}
        self._file.seek(0)
        complete = 0  # bytes
        for line in self._file:
            if not line.endswith(b"\n"):
                break
            complete += len(line)
            entry = _outcome(line)
            if entry is not None:
                outcomes[entry.key] = entry
        self._file.truncate(complete)
        return outcomes


def _outcome(line: bytes) -> Outcome | None:
    try:
        fields: dict[str, Any] = from_json(line)
        outcome = Outcome(**fields)
    except (ValueError, TypeError):
        return None
    return outcome if isinstance(outcome.key, str) else None
