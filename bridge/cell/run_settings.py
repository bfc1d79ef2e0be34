"""From a cell to what a run of the daemon is made of."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from bridge.cell import Cell, load_cell
from bridge.cell.daemon_settings import DaemonSettings
from bridge.served.credentials import check_credentials
from core.errors import CellError, InputError


@dataclass(frozen=True)
class Configuration:
    """A cell file as it was read: what runs, and how to know it again."""

    settings: DaemonSettings
    n: int  # joints
    text: str

    @property
    def hash(self) -> str:
        """Return the SHA-256 of the file."""
        return hashlib.sha256(self.text.encode()).hexdigest()


def configuration_of(cell: Cell) -> Configuration:
    """Return the configuration of a cell that has been read. Raises InputError."""
    return Configuration(settings_of(cell), cell.arm.n, cell.document.text)


def configuration_for(settings: DaemonSettings) -> Configuration:
    """Return the configuration of settings, whose cell file is read for it. Raises InputError."""
    cell = load_cell(settings.cell)
    return Configuration(settings, cell.arm.n, cell.document.text)


def read_configuration(path: Path) -> Configuration:
    """Return the configuration of a cell file, all of it checked. Raises InputError."""
    return configuration_of(load_cell(path))


def settings_of(cell: Cell) -> DaemonSettings:
    """Return what a run of this cell is made of. Raises InputError where sections do not fit."""
    if cell.link is None:
        raise CellError(f"{cell.path}: link: found nothing, expected the robot's address for a run")
    for section, served in (("web", cell.web), ("metrics", cell.metrics)):
        if served is not None:
            try:
                check_credentials(served, section)
            except InputError as error:
                raise CellError(f"{cell.path}: {error}") from None
    try:
        return DaemonSettings(
            cell=cell.path.resolve(), link=cell.link, limits=cell.limits,
            setpoints=cell.setpoints.model_copy(
                update={"file": cell.setpoints.file and cell.setpoints.file.resolve()}
            ),
            recording=cell.recording, ft_sensor=cell.ft_sensor,
            web=cell.web, metrics=cell.metrics,
        )  # fmt: skip
    except ValidationError as error:
        words = str(error.errors()[0]["msg"]).removeprefix("Value error, ")
        raise CellError(f"{cell.path}: {words}") from None
