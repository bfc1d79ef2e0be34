"""The folder for sockets and locks: only its owner can look into it, and it need not be tidied."""

from __future__ import annotations

import hashlib
import os
import stat
import tempfile
from pathlib import Path

from gapbridge.core.errors import InputError


def candidates() -> list[Path]:
    """Return where a daemon of this user may have its folder, best first."""
    found = []
    if given := os.environ.get("RUNTIME_DIRECTORY"):  # systemd's, colon-separated
        found.append(Path(given.split(":")[0]))
    if given := os.environ.get("XDG_RUNTIME_DIR"):
        found.append(Path(given) / "gapbridge")
    found += [
        Path("/run/gapbridge"),
        Path(tempfile.gettempdir()) / f"gapbridge-{os.getuid()}",
    ]
    return found


def runtime_folder() -> Path:
    """Return the folder, made where there is none. Raises InputError where none can be had."""
    refused = ""
    for path in candidates():
        try:
            path.mkdir(mode=0o700, exist_ok=True)
            found = path.lstat()
        except OSError as error:
            refused = f"{path}: {error.strerror}"
            continue
        if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid():
            refused = f"{path}: found a folder of somebody else, or no folder"
            continue
        if stat.S_IMODE(found.st_mode) != 0o700:
            path.chmod(0o700)
        return path
    raise InputError(f"{refused}, expected a folder for the daemon's socket (XDG_RUNTIME_DIR)")


def cell_key(cell: Path) -> str:
    """Return a short name for a cell file: its stem and a hash of its whole path."""
    whole = str(cell.resolve())
    return f"{cell.stem[:40]}-{hashlib.sha256(whole.encode()).hexdigest()[:10]}"
