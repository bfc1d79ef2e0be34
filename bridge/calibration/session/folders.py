"""Where sessions are kept, and which one a call of the command goes on with."""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Any

from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.session.journal import FILE, VERSION, Entry, read_entries
from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.settings.instruments import InstrumentSettings
from gapbridge.core.errors import InputError

SAME = (
    "robot", "tool", "payload", "gravity", "reference_temperature", "compliance", "effects",
)  # keys of a cell that may not change during a session  # fmt: skip


def session_folder(cell: Cell, options: SessionOptions) -> Path:
    """Return the folder of the session to go on with, or of a new one."""
    if options.folder is not None:
        return options.folder
    base = cell.calibration.folder
    stem = f"{cell.path.stem}-{options.kind}" if options.kind != "whole" else cell.path.stem
    found = sorted(base.glob(f"*/{FILE}"), key=lambda p: p.stat().st_mtime, reverse=True)
    for journal in found:
        if _goes_on(journal, cell, options.kind):
            return journal.parent
    today = f"{stem}-{date.today().isoformat()}"
    names = [today, *(f"{today}-{i}" for i in range(2, 1000))]
    return next(base / name for name in names if not (base / name / FILE).exists())


def _goes_on(journal: Path, cell: Cell, kind: str) -> bool:
    """Return whether a journal is one of this cell's that has not ended."""
    try:
        entries = read_entries(journal)
    except InputError:
        return False
    if not entries or entries[0]["kind"] != "begun":
        return False
    same = entries[0].get("cell") == str(cell.path.resolve()) and entries[0].get("job") == kind
    return same and not any(e["kind"] == "ended" for e in entries)


def begun_entry(cell: Cell, options: SessionOptions) -> dict[str, Any]:
    """Return what a session's journal begins with."""
    return {
        "version": VERSION,
        "job": options.kind,
        "cell": str(cell.path.resolve()),
        "arm": cell.arm.name,
        "model": _model_keys(cell),
        "instrument": options.instrument.model_dump(mode="json"),
        "seed": options.seed,
    }


def _model_keys(cell: Cell) -> dict[str, Any]:
    given = cell.file.model_dump(mode="json")
    return {key: given[key] for key in SAME}


def check_begun(begun: Entry, cell: Cell, options: SessionOptions, folder: Path) -> None:
    """Raise InputError where a session was begun for something else than is asked for now."""
    if begun.get("version") != VERSION:
        raise InputError(
            f"{folder}: found a session of version {begun.get('version')}, expected {VERSION}"
        )
    if begun.get("job") != options.kind:
        raise InputError(
            f"{folder}: found a session of kind {begun.get('job')!r}, expected {options.kind!r}: "
            "give another --session"
        )
    before, now = begun.get("model", {}), _model_keys(cell)
    changed = [key for key in SAME if before.get(key) != now[key]]
    if changed:
        raise InputError(
            f"{cell.path}: {changed[0]}: found it changed since the session in {folder} began, "
            "expected the same; for the changed cell begin another with --session"
        )
    measured = _measures(begun.get("instrument", {}))
    if measured != options.instrument.measures:
        raise InputError(
            f"{folder}: found readings of kind {measured}, expected {options.instrument.measures} "
            f"of --instrument {options.instrument.kind}: one session has one kind"
        )


def _measures(entry: dict[str, Any]) -> str:
    from pydantic import TypeAdapter

    adapter: TypeAdapter[InstrumentSettings] = TypeAdapter(InstrumentSettings)
    return adapter.validate_python(entry).measures
