"""Output files: written to a temporary file in the same folder and then renamed, so never partial.

They survive a power cut: the file is synced before it is renamed, its folder afterwards.

A new file has mode 0640, whatever the umask; a file that replaces another keeps its permissions.
"""

from __future__ import annotations

import contextlib
import io
import os
import stat
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import InputError, RunError
from gapbridge.core.log.columns import PARQUET

CSV = ".csv"
YAML = (".yaml", ".yml")
LONG = 50_000  # numbers from which pyarrow writes a table as text: ten times as fast
MODE = 0o640  # of a new file
UNPRINTABLE = "backslashreplace"  # characters that UTF-8 cannot hold, as in names of files
FOLDER_MODE = 0o750  # of a new folder of recordings, sessions and the like


def require_writable(path: Path, *others: Path) -> Path:
    """Return the path if a file can be written there; called before the work is done.

    ``others``: inputs, and outputs named before. Raises InputError where its folder is missing or
    takes no file, it is a folder or a device, or it is one of the others.
    """
    if path.is_dir():
        raise InputError(f"{path}: found a folder, expected a file to write")
    if path.exists() and not path.is_file():  # root would replace /dev/null by a file
        raise InputError(f"{path}: found a device or pipe, expected a file to write")
    folder = path.parent
    if not folder.is_dir():
        raise InputError(f"{path}: found no folder {folder}, expected an existing one")
    try:  # no question finds as much: a full disk, a link to nowhere, a name that is too long
        _, part = _place_and_part(path)
        os.close(private(part, os.O_WRONLY | os.O_CREAT))
        part.unlink()
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    for file in others:
        if path.exists() and file.exists() and path.samefile(file):
            raise InputError(f"{path}: found the output to be the input {file}, expected another")
        if os.path.realpath(path) == os.path.realpath(file):
            raise InputError(f"{path}: found for two outputs, expected two files")
    return path


def require_table(path: Path, *inputs: Path) -> Path:
    """Return the path if a table can be written there; see ``require_writable``.

    Raises InputError also where its suffix is not that of CSV or Parquet.
    """
    require_writable(path, *inputs)
    if path.suffix.lower() not in (CSV, *PARQUET):
        found = path.suffix or "no suffix"
        raise InputError(f"--out {path}: found {found}, expected .csv or .parquet")
    return path


def require_cell(path: Path, *others: Path) -> Path:
    """Return the path if a cell can be written there; see ``require_writable``.

    Raises InputError also for a file that exists with another suffix than YAML's: a log or a report
    named by mistake would be lost.
    """
    require_writable(path, *others)
    return require_suffix(path, YAML) if path.exists() and path.suffix else path


def require_suffix(path: Path, suffixes: Sequence[str]) -> Path:
    """Return the path if it ends in one of the suffixes. Raises InputError."""
    if path.suffix.lower() not in suffixes:
        found = path.suffix or "no suffix"
        raise InputError(f"{path}: found {found}, expected {' or '.join(suffixes)}")
    return path


def require_folder(path: Path, option: str, *, above: bool = True) -> None:
    """Make the folder given by ``option``, and missing parents where ``above``.

    Raises InputError where it cannot be made or written to, or where a parent is missing.
    """
    if path.exists() and not path.is_dir():
        raise InputError(f"{path}: found a file, expected a folder for {option}")
    if not above and not path.parent.is_dir():
        raise InputError(f"{path}: found no folder {path.parent}, expected an existing one")
    try:
        path.mkdir(FOLDER_MODE, parents=above, exist_ok=True)
    except OSError as error:
        raise InputError(f"{path}: folder cannot be made: {error.strerror}") from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise InputError(f"{path}: found a folder that cannot be written to, for {option}")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[IO[str]]:
    """Open a text file that replaces ``path`` when the block ends without an error.

    What is not Unicode (a file's name may hold any bytes) is escaped.
    """
    with replacing_bytes(path) as binary:
        file = io.TextIOWrapper(binary, "utf-8", UNPRINTABLE, newline="\n")
        try:
            yield file
        finally:
            file.detach()  # flushes; replacing_bytes closes the file


@contextlib.contextmanager
def replacing_bytes(path: Path) -> Iterator[IO[bytes]]:
    """Open a binary file that replaces ``path`` when the block ends without an error.

    Raises RunError where it cannot be written; what the block raises of another file stays.
    """
    with _part_of(path) as part:
        yield part.file
        part.sync()
        part.rename()


@dataclass(frozen=True)
class _Part:
    """A file that is being written, beside its place."""

    file: IO[bytes]
    path: Path
    place: Path

    def sync(self) -> None:
        self.file.flush()
        os.fsync(self.file.fileno())

    def rename(self) -> None:
        os.replace(self.path, self.place)
        sync_folder(self.place.parent)  # else a power cut can lose the new file's name


@contextlib.contextmanager
def _part_of(path: Path) -> Iterator[_Part]:
    """Open the part of a file; it is removed at the end, unless it was renamed."""
    part = None
    try:
        place, part = _place_and_part(path)
        with open(part, "wb", opener=private) as file:
            _keep_mode(place, file.fileno())
            yield _Part(file, part, place)
    except OSError as error:
        if error.filename not in (None, str(part)):
            raise
        raise RunError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        if part is not None:
            with contextlib.suppress(OSError):
                part.unlink()


def _place_and_part(path: Path) -> tuple[Path, Path]:
    """Return where a file is, links followed, and its part beside it.

    Raises OSError where the path is relative and the working folder was deleted.
    """
    place = Path(os.path.realpath(path))
    part = place.with_name(f".{place.name}.{os.getpid()}.part")
    return place, part


def sync_folder(folder: Path) -> None:
    """Sync a folder: the name of a file that was synced is lost otherwise."""
    with contextlib.suppress(OSError):  # not every file system supports it
        fd = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


def make_folder(folder: Path) -> None:
    """Make a folder and missing parents (mode 0750), and sync them."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(FOLDER_MODE, parents=True, exist_ok=True)
    for path in missing:
        sync_folder(path.parent)


def private(path: str | Path, flags: int) -> int:
    """Open a file, as ``opener`` of ``open``: a new one has mode 0640."""
    return os.open(path, flags | os.O_CLOEXEC, MODE)


def _keep_mode(place: Path, fd: int) -> None:
    """Give a file the permissions of the one that it replaces."""
    with contextlib.suppress(OSError):
        os.fchmod(fd, stat.S_IMODE(place.stat().st_mode))


def write_text(path: Path, text: str) -> None:
    """Write a text file in one step."""
    with replacing(path) as file:
        file.write(text)


def write_together(contents: Mapping[Path, str | bytes]) -> list[Path]:
    """Write files that belong together, and return their paths.

    All are on the disk before the first is renamed: what fails before leaves the old ones.
    """
    with contextlib.ExitStack() as stack:
        parts = []
        for path, content in contents.items():
            part = stack.enter_context(_part_of(path))
            part.file.write(content if isinstance(content, bytes) else _encoded(content))
            part.sync()
            parts.append(part)
        for part in parts:
            part.rename()
    return list(contents)


def printable(name: object) -> str:
    """Return a name as text that UTF-8 can hold: bytes of it that are not UTF-8 are escaped."""
    return _encoded(str(name)).decode()


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", UNPRINTABLE)


def write_table(path: Path, columns: Sequence[str], table: Array) -> None:
    """Write rows (N, k) under k column names, as Parquet or CSV by the path's suffix.

    Numbers are written exactly.
    """
    with writing_table(path) as append:
        append(columns, table)


@contextlib.contextmanager
def writing_table(path: Path) -> Iterator[Callable[[Sequence[str], Array], None]]:
    """Open a table as ``write_table`` does; returns a function that appends rows (N, k) to it.

    The function takes the same column names each time.
    """
    with replacing_bytes(path) as binary, contextlib.ExitStack() as opened:
        if path.suffix.lower() in PARQUET:
            yield _parquet_to(binary, opened)
        else:
            yield _text_to(binary)


def _parquet_to(
    binary: IO[bytes], opened: contextlib.ExitStack
) -> Callable[[Sequence[str], Array], None]:
    import pyarrow
    from pyarrow.parquet import ParquetWriter

    writers: list[ParquetWriter] = []

    def append(columns: Sequence[str], table: Array) -> None:
        frame = pyarrow.table([table[:, k] for k in range(table.shape[1])], list(columns))
        if not writers:
            # numbers hardly repeat: a dictionary would not compress them
            writer = ParquetWriter(binary, frame.schema, use_dictionary=False)
            writers.append(opened.enter_context(writer))
        writers[0].write_table(frame)

    return append


def _text_to(binary: IO[bytes]) -> Callable[[Sequence[str], Array], None]:
    def append(columns: Sequence[str], table: Array) -> None:
        if binary.seek(0, os.SEEK_END) == 0:
            binary.write((",".join(columns) + "\n").encode())
        if table.size <= LONG:
            np.savetxt(binary, table, fmt="%.17g", delimiter=",")
            return
        import pyarrow
        from pyarrow import csv

        frame = pyarrow.table([table[:, k] for k in range(table.shape[1])], list(columns))
        csv.write_csv(frame, binary, csv.WriteOptions(include_header=False, quoting_style="none"))

    return append
