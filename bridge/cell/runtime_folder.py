"""The daemon's folders: of its sockets and locks (temporary, private), and of what it keeps."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
import tempfile
from pathlib import Path

from gapbridge.core.errors import InputError

LOGINS = Path("/run/user")  # where systemd has the XDG_RUNTIME_DIR of each user who is logged in
PLANNER = ".planner.sock"  # ends the name of a planner's socket; a daemon's ends with .sock


def candidates() -> list[Path]:
    """Return the possible runtime folders of a daemon of this user, preferred first."""
    folders = []
    if folder := os.environ.get("RUNTIME_DIRECTORY"):  # systemd's, colon-separated
        folders.append(Path(folder.split(":")[0]))
    if folder := os.environ.get("XDG_RUNTIME_DIR"):
        folders.append(Path(folder) / "gapbridge")
    folders += [Path("/run/gapbridge"), Path(tempfile.gettempdir()) / f"gapbridge-{os.getuid()}"]
    return folders


def lookups() -> list[Path]:
    """Return the folders where a daemon may listen: the candidates, and those of login sessions.

    ``su``, ``sudo`` and cron have no XDG_RUNTIME_DIR, and must be able to disarm all the same:
    their user's daemon, root everybody's.
    """
    user = os.geteuid()
    sessions = [LOGINS / str(user)] if user else sorted(LOGINS.glob("*"))
    return list(dict.fromkeys([*candidates(), *(folder / "gapbridge" for folder in sessions)]))


def runtime_folder() -> Path:
    """Return the folder, created if missing. Raises InputError if none is usable."""
    problem = ""
    for path in candidates():
        try:
            path.mkdir(mode=0o700, exist_ok=True)
            status = path.lstat()
        except OSError as error:
            problem = f"{path}: {error.strerror}"
            continue
        if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
            problem = f"{path}: found no folder of this user"
            continue
        if stat.S_IMODE(status.st_mode) != 0o700:
            path.chmod(0o700)
        return path
    raise InputError(f"{problem}, expected a folder for the daemon's socket (XDG_RUNTIME_DIR)")


def owner_of(folder: Path) -> int:
    """Return the user whose daemon listens in a runtime folder.

    Oneself; for root also another, where not everybody can make such a folder (as in ``/tmp``).
    Raises PermissionError for whatever else is there, OSError where there is nothing.
    """
    status, user = folder.lstat(), os.geteuid()
    known = status.st_uid == user or not (user or folder.parent.stat().st_mode & stat.S_IWOTH)
    if not stat.S_ISDIR(status.st_mode) or not known:
        raise PermissionError(errno.EPERM, "found no folder of this user", str(folder))
    return status.st_uid


def state_folder() -> Path:
    """Return the folder of what outlives a power cycle, created if missing.

    systemd's ``$STATE_DIRECTORY``, else ``gapbridge`` in the user's own. Raises InputError if it
    cannot be used.
    """
    if folder := os.environ.get("STATE_DIRECTORY"):  # colon-separated
        path = Path(folder.split(":")[0])
    else:
        home = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
        path = Path(home) / "gapbridge"
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = path.stat()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}, expected a folder to keep state in") from None
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.geteuid():
        raise InputError(f"{path}: found no folder of this user, expected one to keep state in")
    return path


def cell_key(cell: Path) -> str:
    """Return a short name for a cell file: stem and hash of its path, all links followed.

    Raises nothing: a daemon must be found whatever has become of its file.
    """
    path = os.path.realpath(cell)
    stem = os.fsencode(Path(path).stem)[:40].decode(errors="ignore")  # bytes: 107 in all
    return f"{stem}-{hashlib.sha256(os.fsencode(path)).hexdigest()[:10]}"
