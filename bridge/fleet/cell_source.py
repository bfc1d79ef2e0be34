"""The cell of each session: one for all, one near each log, or from a table."""

from __future__ import annotations

import csv
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.fleet.session import Session
from gapbridge.core.errors import CellError, InputError

BESIDE = "beside"
CELL_NAMES = ("cell.yaml", "cell.yml")


class CellSource(ABC):
    """Finds the cell file of a session."""

    @abstractmethod
    def cell_of(self, session: Session) -> Path:
        """Return the session's cell file; raises InputError if it has none."""

    def warnings(self) -> tuple[str, ...]:
        """Return warnings to report before the run."""
        return ()

    def inputs(self) -> tuple[Path, ...]:
        """Return the table, and the cells that are known before the sessions are."""
        return ()


@dataclass(frozen=True)
class OneCell(CellSource):
    """The same cell for every session."""

    path: Path

    def cell_of(self, session: Session) -> Path:
        """Return the cell."""
        return self.path

    def warnings(self) -> tuple[str, ...]:
        """Return the warnings of the cell; raises CellError if it cannot be used."""
        return load_cell(self.path).warnings

    def inputs(self) -> tuple[Path, ...]:
        """Return the cell."""
        return (self.path,)


@dataclass(frozen=True)
class CellNearLog(CellSource):
    """A cell near each log: named like it, or ``cell.yaml`` in its folder or one above."""

    folder: Path  # of the fleet, the topmost one searched

    def cell_of(self, session: Session) -> Path:
        """Return the nearest cell."""
        candidates = [session.log.with_suffix(suffix) for suffix in (".yaml", ".yml")]
        top = self.folder.absolute()
        for place in session.log.absolute().parents:
            candidates += [place / name for name in CELL_NAMES]
            if place == top:
                break
        for path in candidates:
            if path.is_file():
                return path
        raise CellError(
            f"{session.log}: found no cell beside it, expected {candidates[0].name} or cell.yaml "
            f"there, or cell.yaml in a folder above up to {self.folder}"
        )


@dataclass(frozen=True)
class CellTable(CellSource):
    """A CSV of columns ``arm`` and ``cell``; paths are relative to the table's folder."""

    path: Path
    cells: dict[str, Path]

    def cell_of(self, session: Session) -> Path:
        """Return the cell of the session's arm."""
        try:
            return self.cells[session.arm]
        except KeyError:
            raise CellError(
                f"{session.log}: {self.path}: found no row for arm {session.arm!r}, expected one"
            ) from None

    def inputs(self) -> tuple[Path, ...]:
        """Return the table and all its cells."""
        return (self.path, *self.cells.values())


def cell_source(text: str, folder: Path) -> CellSource:
    """Return the source that ``--cell`` names: a cell file, a table (.csv) or ``beside``.

    Raises InputError if the table cannot be used.
    """
    if text == BESIDE:
        return CellNearLog(folder)
    path = Path(text)
    return _table(path) if path.suffix.lower() == ".csv" else OneCell(path)


def _table(path: Path) -> CellTable:
    if not path.is_file():
        raise InputError(f"{path}: file not found, expected a table with columns arm and cell")
    cells: dict[str, Path] = {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = csv.DictReader(file)
            names = rows.fieldnames or []
            if not {"arm", "cell"} <= set(names):
                raise InputError(
                    f"{path}: header: found {', '.join(names) or 'nothing'}, expected columns "
                    "arm and cell"
                )
            for row in rows:
                arm, cell = (row["arm"] or "").strip(), (row["cell"] or "").strip()
                if not arm or not cell:
                    raise InputError(
                        f"{path}: row {rows.line_num}: found no {'cell' if arm else 'arm'}, "
                        "expected both"
                    )
                if "\0" in arm + cell:
                    raise InputError(
                        f"{path}: row {rows.line_num}: found {arm + ',' + cell!r}, expected no \\0 "
                        "in it"
                    )
                if arm in cells:
                    raise InputError(
                        f"{path}: row {rows.line_num}: found arm {arm!r} twice, expected once"
                    )
                cells[arm] = path.parent / cell
    except (UnicodeDecodeError, csv.Error):
        raise InputError(f"{path}: found no readable CSV (UTF-8), expected a table") from None
    return CellTable(path, cells)
