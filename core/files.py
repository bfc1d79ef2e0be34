"""Reading the files that a configuration is made of: once, and from then on the same bytes.

Every reader of a cell, and of what a cell names, reads through here. A process may record what it
reads (``recorded``) and hand it to another one, which then reads those bytes and nothing else
(``read_only_from``): a file that was edited meanwhile does not exist for it.
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from pathlib import Path

_recording: ContextVar[dict[str, bytes] | None] = ContextVar("_recording", default=None)
_given: Mapping[str, bytes] | None = None


def read_bytes(path: Path) -> bytes:
    """Return a file's bytes. Raises OSError."""
    if _given is not None:
        for key in _keys(path):
            if key in _given:
                return _given[key]
        message = "not among the files of the configuration that runs"
        raise FileNotFoundError(errno.ENOENT, message, str(path))
    found = path.read_bytes()
    if (recording := _recording.get()) is not None:
        recording.update(dict.fromkeys(_keys(path), found))
    return found


def _keys(path: Path) -> tuple[str, str]:
    """Return the names that a file may be asked for by: links on the way may be followed or not."""
    return os.path.abspath(path), os.path.realpath(path)


def read_text(path: Path, encoding: str = "utf-8") -> str:
    """Return a file's text, line ends as newlines. Raises OSError, UnicodeDecodeError."""
    return read_bytes(path).decode(encoding).replace("\r\n", "\n").replace("\r", "\n")


def is_given() -> bool:
    """Return whether this process reads files that another one has read."""
    return _given is not None


def is_file(path: Path) -> bool:
    """Return whether there is a file to read."""
    return path.is_file() if _given is None else any(key in _given for key in _keys(path))


@contextlib.contextmanager
def recorded() -> Iterator[dict[str, bytes]]:
    """Give what is read inside, by absolute path; in this thread only."""
    found: dict[str, bytes] = {}
    token = _recording.set(found)
    try:
        yield found
    finally:
        _recording.reset(token)


def read_only_from(files: Mapping[str, bytes]) -> None:
    """Have this process read these files from now on, and no others."""
    global _given
    _given = dict(files)
