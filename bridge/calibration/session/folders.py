"""Folders of sessions: which session a call of the command resumes, or starts."""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Any

from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.session.journal import FILE, VERSION, Entry, read_entries
from gapbridge.bridge.cell import Cell
from gapbridge.bridge.cell.settings.instruments import (
    METRES,
    DialGaugeSettings,
    InstrumentSettings,
    SphereSettings,
)
from gapbridge.core.errors import InputError
from gapbridge.drivers.controller_address import address_of

FIXED_KEYS = (
    "robot", "tool", "payload", "gravity", "reference_temperature", "compliance", "effects",
)  # keys of the cell that must not change during a session  # fmt: skip


def session_folder(cell: Cell, options: SessionOptions) -> Path:
    """Return the folder of the cell's latest unfinished session, or of a new one."""
    if options.folder is not None:
        return options.folder
    base = cell.calibration.folder
    stem = f"{cell.path.stem}-{options.kind}" if options.kind != "whole" else cell.path.stem
    journals = sorted(base.glob(f"*/{FILE}"), key=lambda p: p.stat().st_mtime, reverse=True)
    for journal in journals:
        if _is_unfinished(journal, cell, options.kind):
            return journal.parent
    today = f"{stem}-{date.today().isoformat()}"
    names = [today, *(f"{today}-{i}" for i in range(2, 1000))]
    return next(base / name for name in names if not (base / name / FILE).exists())


def _is_unfinished(journal: Path, cell: Cell, kind: str) -> bool:
    """Return whether a journal is an unfinished session of this cell and kind."""
    try:
        entries = read_entries(journal)
    except InputError:
        return False
    begun = next((entry for entry in reversed(entries) if entry["kind"] == "begun"), None)
    if begun is None:
        return False
    same = begun.get("cell") == str(cell.path.resolve()) and begun.get("job") == kind
    return same and not any(e["kind"] == "ended" for e in entries)


def start_entry(cell: Cell, options: SessionOptions) -> dict[str, Any]:
    """Return the fields of the first entry of a journal, of kind ``begun``."""
    return {
        "version": VERSION,
        "job": options.kind,
        "cell": str(cell.path.resolve()),
        "arm": cell.arm.name,
        "model": _model_keys(cell),
        "loads": _loads(cell),
        **_identity(cell),
        "instrument": options.instrument.model_dump(mode="json"),
        "seed": options.seed,
    }


def _model_keys(cell: Cell) -> dict[str, Any]:
    settings = cell.file.model_dump(mode="json")
    return {key: settings[key] for key in FIXED_KEYS}


def _loads(cell: Cell) -> list[list[float]]:
    """Return mass and centre of gravity of the session's loads, lightest first."""
    return sorted([load.mass, *load.cog] for load in cell.calibration.loads)


def _identity(cell: Cell) -> dict[str, str]:
    """Return what identifies the cell's arm among others of its model; empty text: not given."""
    link = "" if cell.link is None else address_of(cell.link)
    return {"link": link, "serial": cell.calibration.serial}


def check_start(entry: Entry, cell: Cell, options: SessionOptions, folder: Path) -> None:
    """Raise InputError if a session was started with another arm, model, kind or instrument."""
    if entry.get("version") != VERSION:
        raise InputError(
            f"{folder}: found a session of version {entry.get('version')}, expected {VERSION}"
        )
    if entry.get("job") != options.kind:
        raise InputError(
            f"{folder}: found a session of kind {entry.get('job')!r}, expected {options.kind!r}: "
            "give another --session"
        )
    old, new = entry.get("model", {}), _model_keys(cell)
    changed = [key for key in FIXED_KEYS if old.get(key) != new[key]]
    if changed:
        raise InputError(
            f"{cell.path}: {changed[0]}: found it changed since the session in {folder} began, "
            "expected the same; for the changed cell begin another with --session"
        )
    if entry.get("loads", _loads(cell)) != _loads(
        cell
    ):  # the readings so far are with the old ones
        raise InputError(
            f"{cell.path}: calibration.loads: found them changed since the session in {folder} "
            "began, expected the same; for other loads begin another with --session"
        )
    for key, name in (("link", "link"), ("serial", "calibration.serial")):
        before, now = entry.get(key), _identity(cell)[key]
        if before and now and before != now:
            raise InputError(
                f"{cell.path}: {name}: found {now!r}, expected {before!r} of the session in "
                f"{folder}; for another arm begin another with --session"
            )
    _check_instrument(_instrument_of(entry, folder), options.instrument, folder)


def _check_instrument(before: InstrumentSettings, now: InstrumentSettings, folder: Path) -> None:
    """Raise InputError if two instruments' readings do not belong into one session."""
    if before.measures != now.measures:
        raise InputError(
            f"{folder}: found readings of kind {before.measures}, expected {now.measures} "
            f"of --instrument {now.kind}: one session has one kind"
        )
    expected, found = _lengths(before), _lengths(now)
    for name in expected.keys() & found.keys():
        if expected[name] != found[name]:
            raise InputError(
                f"{folder}: found an instrument whose {name} is {found[name]}, expected "
                f"{expected[name]} as when the session began; begin another with --session"
            )


def _lengths(instrument: InstrumentSettings) -> dict[str, str]:
    """Return the lengths that its readings contain, as text."""
    lengths: dict[str, float | None] = {}
    if isinstance(instrument, DialGaugeSettings):
        zero = instrument.zero
        lengths["zero"] = None if zero is None else zero * METRES[instrument.unit]
    elif isinstance(instrument, SphereSettings):
        lengths["radius"] = instrument.radius
    return {k: "to be estimated" if v is None else f"{v:.9g} m" for k, v in lengths.items()}


def _instrument_of(entry: Entry, folder: Path) -> InstrumentSettings:
    from pydantic import TypeAdapter, ValidationError

    adapter: TypeAdapter[InstrumentSettings] = TypeAdapter(InstrumentSettings)
    try:
        return adapter.validate_python(entry.get("instrument"))
    except ValidationError:
        raise InputError(
            f"{folder / FILE}: instrument: found none that is known, expected that of the session"
        ) from None
