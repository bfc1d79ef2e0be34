"""The mark that a failed verification leaves beside a cell: its daemon does not arm with it.

It is written by ``calibrate --verify`` and removed by a verification that passes, by a new
calibration of the cell, or by a person (``gapbridge disarm``, or deleting the file).
"""

from __future__ import annotations

import json
import os
import stat
from pathlib import Path

from gapbridge.bridge.document.output_file import sync_folder, write_text
from gapbridge.core.errors import RunError

SCHEMA = "gapbridge.verification_failed/1"
LONGEST = 65536  # bytes
LONGEST_REASON = 600  # characters


def mark_path(cell: Path) -> Path:
    """Return the path of a cell's mark; of a link, beside the file that it leads to."""
    place = Path(os.path.realpath(cell))  # raises nothing
    return place.with_name(f"{place.stem}.verification_failed.json")


def write_mark(cell: Path, reason: str, session: Path) -> Path:
    """Write the mark of a failed verification; returns its path. Raises RunError."""
    path = mark_path(cell)
    document = {"schema": SCHEMA, "reason": reason, "session": str(session.resolve())}
    write_text(path, json.dumps(document, indent=1) + "\n")
    return path


def read_mark(cell: Path) -> str:
    """Return why the cell's verification failed, in one line; empty: there is no mark.

    What cannot be read counts as a mark.
    """
    path = mark_path(cell)
    try:
        reason = _reason(path)
    except FileNotFoundError:
        return ""
    except OSError as error:
        reason = f"found a mark that cannot be read ({error.strerror})"
    return f"{path}: {reason}"


def _reason(path: Path) -> str:
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)  # a pipe does not block
    try:
        data = os.read(fd, LONGEST) if stat.S_ISREG(os.fstat(fd).st_mode) else b""
    finally:
        os.close(fd)
    try:
        document = json.loads(data)
        reason, schema = document["reason"], document["schema"]
    except (ValueError, TypeError, KeyError, RecursionError):
        reason = schema = None
    if schema != SCHEMA or not isinstance(reason, str) or not reason.strip():
        return "found no mark that can be read, expected that of a failed verification"
    shown = "".join(c if c.isprintable() else " " for c in reason)
    return " ".join(shown.split())[:LONGEST_REASON]


def remove_mark(cell: Path) -> bool:
    """Remove the mark; returns whether there was one. Raises RunError where that fails."""
    path = mark_path(cell)
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    except OSError as error:
        raise RunError(f"{path}: cannot be removed: {error.strerror}; remove it by hand") from error
    sync_folder(path.parent)
    return True
