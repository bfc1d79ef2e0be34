"""Where a result comes from: version, time, the command's arguments, and the files it read."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from gapbridge.bridge.document.output_file import printable
from gapbridge.core.calibration.spread import Spread

if TYPE_CHECKING:
    from gapbridge.bridge.document.blocks import Block

BLOCK = 1 << 20  # bytes read at a time
HALF_WIDTH = 1.96  # of a 95 % interval, in standard deviations


def provenance(
    files: Mapping[str, Sequence[Path]], command: str = "", **options: object
) -> dict[str, Any]:
    """Return the provenance of the running command's result, as JSON and cells hold it.

    ``files`` are its inputs by role (``log``, ``cell``); a folder means all of its files.
    Arguments are those of the command that differ from their defaults; called from Python, the
    command is ``command`` and its arguments are these files and ``options``.
    """
    context = click.get_current_context(silent=True)
    paths_by_role = {
        role: [printable(path) for path in paths] for role, paths in files.items() if paths
    }
    called = paths_by_role | {name: value for name, value in options.items() if value}
    return {
        "version": installed_version(),
        "time": datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z"),
        "command": command if context is None else _command(context),
        "arguments": called if context is None else _arguments(context),
        "files": [
            {"role": role, "name": printable(path.name), "sha256": digest(path)}
            for role, paths in files.items()
            for path in paths
        ],
    }


def origin_line(origin: Mapping[str, Any]) -> str:
    """Return version and time in one line, for the head and foot of a report."""
    return f"Gapbridge {origin.get('version', '')} · {origin.get('time', '')}".strip(" ·")


def origin_blocks(origin: Mapping[str, Any]) -> list[Block]:
    """Return version, time, arguments and files with SHA-256 as blocks; empty without origin."""
    from gapbridge.bridge.document.blocks import (  # only where there is a report
        Columns,
        Heading,
        Pairs,
        Table,
    )

    if not origin:
        return []
    arguments = ", ".join(f"{k} {_argument(v)}" for k, v in origin["arguments"].items())
    pairs = [("software", f"Gapbridge {origin['version']}"), ("time (UTC)", origin["time"]),
             ("command", f"gapbridge {origin['command']}" if origin["command"] else ""),
             ("arguments", arguments)]  # fmt: skip
    rows = [[f["role"], f["name"], f["sha256"] or "not readable"] for f in origin["files"]]
    blocks: list[Block] = [
        Heading("Origin"), Columns((Pairs(tuple((k, v) for k, v in pairs if v)),)),
    ]  # fmt: skip
    return [*blocks, Table(("file", "name", "SHA-256"), rows, (0.7, 2, 4))] if rows else blocks


def _argument(value: Any) -> str:
    return " ".join(str(v) for v in value) if isinstance(value, list) else str(value)


def fitted(
    origin: dict[str, Any], ranges: Mapping[str, tuple[float, float]], spread: Spread,
    intervals: Mapping[str, tuple[float, float]], causes: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:  # fmt: skip
    """Return the provenance of a cell whose model was fitted.

    ``ranges``: fitted range of each quantity. ``spread``: covariance of the parameters.
    ``intervals``: 95 % intervals of the applied values by name, SI. ``causes``: named causes, as in
    the schema of cells.
    """
    listed = {name: [low, high] for name, (low, high) in ranges.items()}
    result = {**origin, "fitted": listed}
    if intervals:
        result["intervals"] = {name: [low, high] for name, (low, high) in intervals.items()}
    if spread.names:
        result |= {"parameters": list(spread.names), "covariance": spread.covariance.tolist()}
    if causes:
        result["causes"] = [dict(cause) for cause in causes]
    return result


def intervals_of(
    estimates: Iterable[tuple[str, float, float | None]],
) -> dict[str, tuple[float, float]]:
    """Return the 95 % interval of each (name, value, standard deviation or None), by name."""
    return {
        name: (float(value - HALF_WIDTH * std), float(value + HALF_WIDTH * std))
        for name, value, std in estimates
        if std is not None and math.isfinite(std)
    }


def installed_version() -> str:
    """Return the version of the package, or "unknown" where it is not installed."""
    from importlib.metadata import PackageNotFoundError, version  # a hundredth of a second

    try:
        return version("gapbridge")
    except PackageNotFoundError:
        return "unknown"


def digest(path: Path) -> str | None:
    """Return the SHA-256 of a file, or of all files of a folder by name; None: unreadable."""
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    result = hashlib.sha256()
    try:
        for file in files:
            with file.open("rb") as stream:
                while block := stream.read(BLOCK):
                    result.update(block)
    except OSError:
        return None
    return result.hexdigest()


def _command(context: click.Context) -> str:
    """Return the name of the running command, with those of its groups: ``fleet fit``."""
    name = str(context.info_name)
    group = context.parent
    while group is not None and group.parent is not None:
        name, group = f"{group.info_name} {name}", group.parent
    return name


def _arguments(context: click.Context) -> dict[str, Any]:
    given = {}
    for parameter in context.command.params:
        value = context.params.get(parameter.name or "")
        if value is None or value is False or value == ():
            continue
        option = isinstance(parameter, click.Option)
        name = max(parameter.opts, key=len).lstrip("-") if option else parameter.name or ""
        given[name] = _plain(value)
    return given


def _plain(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return value if isinstance(value, (bool, int, float)) else printable(value)
