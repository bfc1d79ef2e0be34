"""The configuration of a daemon run, read and checked from a cell file."""

from __future__ import annotations

import contextlib
import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from gapbridge.bridge.cell import Cell, load_cell
from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.message import located
from gapbridge.bridge.cell.runtime_folder import PLANNER, cell_key, runtime_folder
from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.bridge.served.credentials import SETPOINT_TOKEN, check_credentials, read_token
from gapbridge.core.errors import CellError, InputError
from gapbridge.core.files import read_bytes, recorded
from gapbridge.core.fitted_range import Range
from gapbridge.core.model import Model

LONGEST_SOCKET = 107  # bytes of its path, as Linux limits it: unix(7)


@dataclass(frozen=True)
class Configuration:
    """A cell file as it was read: the settings of the run, its text and all its files."""

    settings: DaemonSettings
    n: int  # joints
    text: str
    files: Mapping[str, bytes]  # contents of every file read for it, by absolute path
    fitted: Range = field(default_factory=dict)  # data range of the fit, by log column
    model: Model | None = None  # for checks of the daemon; the loop process reads its own

    @property
    def hash(self) -> str:
        """Return the SHA-256 of the file."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    @property
    def fingerprint(self) -> str:
        """Return the SHA-256 of the file and of all files that it refers to."""
        digests = [hashlib.sha256(self.files[name]).digest() for name in sorted(self.files)]
        return hashlib.sha256(self.text.encode() + b"".join(digests)).hexdigest()

    @property
    def digests(self) -> dict[str, str]:
        """Return the SHA-256 of every file, by absolute path."""
        return {name: hashlib.sha256(data).hexdigest() for name, data in self.files.items()}


def configuration_for(settings: DaemonSettings) -> Configuration:
    """Return the configuration of given settings; reads their cell file. Raises InputError."""
    return _read(settings.cell, settings)


def read_configuration(path: Path) -> Configuration:
    """Return the checked configuration of a cell file. Raises InputError."""
    return _read(path, None)


def _read(path: Path, settings: DaemonSettings | None) -> Configuration:
    """Read a cell file and all files that its settings, or the given ones, refer to."""
    with recorded() as files:
        cell = load_cell(path)
        settings = settings or settings_of(cell)
        try:
            _read_referenced_files(settings)
        except InputError as error:
            raise located(cell.document, error) from None
    text, fitted = cell.document.text, cell.fitted_range
    return Configuration(settings, cell.arm.n, text, files, fitted, cell.model)


def _read_referenced_files(settings: DaemonSettings) -> None:
    """Read the files that the settings refer to. Raises InputError."""
    settings.link.read_files()
    setpoints = settings.setpoints
    if setpoints.source == "trajectory" and setpoints.file is not None:
        with contextlib.suppress(OSError):  # the loop process reports the error
            read_bytes(setpoints.file)
    if setpoints.source == "tcp" and setpoints.token_file is not None:
        read_token(setpoints.token_file, SETPOINT_TOKEN)


def settings_of(cell: Cell) -> DaemonSettings:
    """Return the daemon settings of a cell. Raises InputError if sections contradict each other."""
    if cell.link is None:
        raise cell.error(("link",), "found nothing, expected the robot's address for a run")
    try:
        for section, served in (("web", cell.web), ("metrics", cell.metrics)):
            if served is not None:
                check_credentials(served, section)
        return DaemonSettings(
            cell=cell.path.resolve(), link=cell.link, limits=cell.limits,
            setpoints=_setpoint_settings(cell), recording=cell.recording,
            ft_sensor=cell.ft_sensor, web=cell.web, metrics=cell.metrics,
        )  # fmt: skip
    except InputError as error:
        raise located(cell.document, error) from None


def _setpoint_settings(cell: Cell) -> SetpointSettings:
    """Return section ``setpoints`` with absolute paths. Raises InputError.

    Its token and its socket's path are checked.
    """
    section = cell.setpoints
    update = {
        name: path.resolve()
        for name in ("file", "socket", "token_file")
        if (path := getattr(section, name)) is not None
    }
    if section.source == "planner" and section.socket is None:
        update["socket"] = runtime_folder() / f"{cell_key(cell.path)}{PLANNER}"
    elif section.source == "planner":
        _require_socket_path(update["socket"])
    if section.source == "tcp" and section.token_file is not None:
        read_token(section.token_file, SETPOINT_TOKEN)
    return section.model_copy(update=update)


def _require_socket_path(path: Path) -> None:
    """Raise CellError unless a Unix socket can be made at ``path``."""
    found = ""
    if not path.parent.is_dir():
        found = f"found no folder {path.parent}"
    elif path.exists() and not path.is_socket():
        found = f"found a {'folder' if path.is_dir() else 'file'}"
    elif (length := len(os.fsencode(path))) > LONGEST_SOCKET:
        found = f"found {length} bytes"
    if found:
        expected = f"a path for a Unix socket, of at most {LONGEST_SOCKET} bytes"
        raise CellError(f"{path}: {found}, expected {expected}", ("setpoints", "socket"))
