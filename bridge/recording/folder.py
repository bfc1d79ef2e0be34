"""The folder of recordings: names of files, where a run continues, which files are removed."""

from __future__ import annotations

import contextlib
import fcntl
import re
import subprocess
from datetime import datetime
from pathlib import Path
from typing import IO, Self

from gapbridge.bridge.document.output_file import private, require_folder
from gapbridge.core.errors import InputError, LinkError
from gapbridge.core.log.mcap_reading import SUFFIX, files_of, last_batch
from gapbridge.drivers.clock import Clock

NAME = re.compile(r"(?P<session>.+)-(?P<number>\d{3,})\.mcap$")
LOOP_LOG = ".loop.log"
MB = 1e6
STEM = re.compile(r"run-\d{8}-\d{6}")
CLOCK_SET = 1_767_225_600.0  # s since 1970: before 2026 a computer's clock has not been set


class RunFiles:
    """The name of a run, and its files in the folder of recordings (None: it records nothing).

    ``log``: the file of its processes' output. A run that is refused at its start (InputError,
    LinkError) leaves no files, unless ``keep`` was called: a service is started every 2 s while its
    robot is off.
    """

    def __init__(self, folder: Path | None, clock: Clock) -> None:
        self._folder, self._clock = folder, clock
        self._kept = False
        self.session = ""
        self.log: IO[bytes] | int = subprocess.DEVNULL

    def keep(self) -> None:
        """Keep the files, however the run ends."""
        self._kept = True

    def __enter__(self) -> Self:
        """Take a name. Raises InputError where the folder cannot be used.

        A full disk is no reason not to run: there is no log, and the recorder waits for room.
        """
        now = self._clock.time()
        if self._folder is None:
            self.session = new_session(None, now)
            return self
        require_folder(self._folder, "recording.folder")
        try:
            self.session = new_session(self._folder, now)
            log = self._folder / f"{self.session}{LOOP_LOG}"
            self.log = open(log, "ab", opener=private)
        except OSError:
            self.session = new_session(None, now)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._folder is None or isinstance(self.log, int):
            return
        self.log.close()
        if kind is not None and issubclass(kind, InputError | LinkError) and not self._kept:
            for path in (*segments(self._folder, self.session), Path(self.log.name)):
                with contextlib.suppress(OSError):
                    path.unlink()


def new_session(folder: Path | None, begin: float) -> str:
    """Return an unused name for a run that begins at ``begin`` (s since 1970), and take it.

    run-YYYYmmdd-HHMMSS in local time, with a number after it where that is taken: also where the
    clock has not been set, whose run is named after the newest one; else ``prune`` would take it
    for the oldest. The name is taken by its loop log, so that no other daemon gets it. Raises
    OSError where that cannot be created.
    """
    stem, number = f"{datetime.fromtimestamp(begin):run-%Y%m%d-%H%M%S}", 1
    if folder is not None and begin < CLOCK_SET:
        names = (STEM.match(session) for session, _, _ in recordings(folder))
        stem = max([stem, *(name[0] for name in names if name)])
    name = stem
    while folder is not None and not _take(folder, name):
        number += 1
        name = f"{stem}-{number}"
    return name


def _take(folder: Path, session: str) -> bool:
    """Create the loop log of a run; returns whether the name was free."""
    if segments(folder, session):
        return False
    try:
        with open(folder / f"{session}{LOOP_LOG}", "xb", opener=private):
            return True
    except FileExistsError:
        return False


def recordings(folder: Path) -> list[tuple[str, int, Path]]:
    """Return run, number and path of each file that a recorder named, in this order.

    Names alone do not order them: -1000.mcap sorts before -999.mcap. Raises OSError.
    """
    matches = [(path, NAME.match(path.name)) for path in folder.iterdir()]
    found = ((match["session"], int(match["number"]), path) for path, match in matches if match)
    return sorted(found, key=lambda file: (_order(file[0]), *file))


def _order(session: str) -> tuple[str, int]:
    """Return what orders runs: -10 comes after -2."""
    stem = STEM.match(session)
    number = session[stem.end() + 1 :] if stem else ""
    return (stem[0], int(number)) if stem and number.isdecimal() else (session, 0)


def segments(folder: Path, session: str) -> list[Path]:
    """Return the files of a run, in order."""
    if not folder.is_dir():
        return []
    return [path for name, _, path in recordings(folder) if name == session]


def next_path(folder: Path, session: str) -> Path:
    """Return the name of the next file of a run: SESSION-001.mcap, ..."""
    files = segments(folder, session)
    match = NAME.match(files[-1].name) if files else None
    return folder / f"{session}-{int(match['number']) + 1 if match else 1:03d}{SUFFIX}"


def number_after(path: Path) -> int:
    """Return the number after a file's last cycle; 0 if it has none."""
    batch = last_batch(path)
    return 0 if batch is None else int(batch.columns["number"].max()) + 1


def prune(folder: Path, session: str, keep_total: float | None) -> list[Path]:
    """Remove the oldest files until recordings take no more than ``keep_total`` MB; return them.

    Files of other runs are removed first, then this run's oldest. Only files named by a recorder
    are removed, and none that one is writing (several daemons may share a folder) or that is
    replayed. Raises nothing: files that cannot be removed are kept.
    """
    if keep_total is None:
        return []
    sizes = _sizes(folder)
    total, gone = sum(sizes.values()), {}
    for name, path in sorted(sizes, key=lambda file: file[0] == session):  # keeps their order
        if total <= keep_total * MB:
            break
        with contextlib.suppress(OSError):
            if _remove(path):
                total -= sizes[name, path]
                gone[path] = name
    for name in set(gone.values()):
        if name != session and not segments(folder, name):
            with contextlib.suppress(OSError):
                (folder / f"{name}{LOOP_LOG}").unlink()
    return list(gone)


def _sizes(folder: Path) -> dict[tuple[str, Path], int]:
    """Return bytes by run and path, in the order of ``recordings``."""
    sizes = {}
    for name, _, path in recordings(folder):
        with contextlib.suppress(OSError):  # another daemon has removed it
            if path.is_file():
                sizes[name, path] = path.stat().st_size
    return sizes


def hold(recording: Path) -> list[IO[bytes]]:
    """Return the files of a recording, opened: until they are closed, ``prune`` removes none.

    Raises OSError, LogError where there is none.
    """
    held: list[IO[bytes]] = [path.open("rb") for path in files_of(recording)]
    for file in held:
        with contextlib.suppress(OSError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    return held


def _remove(path: Path) -> bool:
    """Remove a file unless somebody holds its lock; returns whether it was removed."""
    with path.open("r+b") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:  # a file system without locks: no recorder could take one either
            pass
        path.unlink()
    return True
