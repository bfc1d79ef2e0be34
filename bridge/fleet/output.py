"""Writes what a run has found: tables, report, cells; returns the lines for the terminal.

Tables are Parquet.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.bridge.cell import load_cell, save_cell
from gapbridge.bridge.document.output_file import replacing_bytes, write_text
from gapbridge.bridge.fleet.diagnosis_summary import Diagnosed, diagnosed
from gapbridge.bridge.fleet.fit_summary import (
    Fitted,
    FittedArm,
    FittedType,
    fitted,
    rows,
    session_figures,
)
from gapbridge.bridge.fleet.report.page import write_diagnosed_report, write_fitted_report
from gapbridge.bridge.fleet.report.shared_sections import quantity_title, type_title
from gapbridge.bridge.fleet.runner import Done
from gapbridge.bridge.fleet.session import Found
from gapbridge.bridge.fleet.task import Outcome
from gapbridge.bridge.report.labels import counted, effect_title, joint_list, with_unit
from gapbridge.core.estimation.compliance_fit import flexibilities

SHOWN = 8  # lines of a kind on the terminal; all are in the tables
TABLE = "cells.csv"
RESULTS, SESSIONS = "results.parquet", "sessions.parquet"
CHANNELS = ("position", "wrench", "tracking", "torque")
FIGURES = {"gap_rms": "float64", "gap_max": "float64", "noise_floor_rms": "float64",
           "remaining_rms": "float64", "remaining_rms_held_out": "float64"}  # fmt: skip
SESSION = {
    "arm": "string", "session": "string", "type": "string", "log": "string", "cell": "string",
    "state": "string", "error": "string", "seconds": "float64", "processor": "float64",
    "time": "float64", "poses": "int64", "joints": "int64",
}  # fmt: skip
EFFECT = {
    "arm": "string", "session": "string", "type": "string", "time": "float64",
    "channel": "string", "effect": "string", "accused": "bool", "joints": "list<int64>",
    "parameter": "string", "value": "float64", "std": "float64", "unit": "string",
    "probability": "float64", "shrink": "float64", "shrink_low": "float64",
    "shrink_high": "float64", "shrink_alone": "float64",
    "indistinguishable_from": "list<string>",
}  # fmt: skip
DIAGNOSED = {
    **SESSION, "verdict": "string",
    **{f"{c}_{f}": kind for c in CHANNELS
       for f, kind in {"verdict": "string", "samples": "int64", **FIGURES}.items()},
}  # fmt: skip
FLEXIBILITY = {
    "level": "string", "type": "string", "arm": "string", "session": "string",
    "parameter": "string", "joint": "int64", "value": "float64", "std": "float64",
    "low": "float64", "high": "float64", "unit": "string", "shown": "bool",
    "scatter": "float64", "own_share": "float64", "drift": "float64", "drift_std": "float64",
    "drift_per": "string",
}  # fmt: skip
FITTED = {
    **SESSION, "outliers": "int64", "noise": "float64", "gap_before": "float64",
    "gap_after": "float64", "gap_held_out": "float64", "surprise": "float64",
}  # fmt: skip


def write_diagnosed(done: Done, found: Found, folder: Path) -> tuple[list[str], list[Path]]:
    """Write the results of ``fleet diagnose``; returns lines for the terminal, and the files."""
    together = diagnosed(done.outcomes)
    files = [
        write_parquet(folder / RESULTS, EFFECT, list(effect_rows(done.outcomes))),
        write_parquet(folder / SESSIONS, DIAGNOSED, list(diagnosed_rows(done.outcomes))),
        write_diagnosed_report(together, done, found, folder),
    ]
    return _diagnosed_lines(together), files


def write_fitted(
    done: Done, found: Found, folder: Path, cells: Path | None
) -> tuple[list[str], list[Path]]:
    """Write the results of ``fleet fit``, and the cells where they are wanted."""
    together = fitted(done.outcomes)
    figures = session_figures(together)
    sessions = [row | figures.get(row["session"], {}) for row in session_rows(done.outcomes)]
    files = [
        write_parquet(folder / RESULTS, FLEXIBILITY, list(rows(together))),
        write_parquet(folder / SESSIONS, FITTED, sessions),
        write_fitted_report(together, done, found, folder),
    ]
    if cells is not None:
        files.append(write_cells(together, cells)[-1])
    return _fitted_lines(together), files


def _diagnosed_lines(together: Diagnosed) -> list[str]:
    lines = []
    for one in together.recurrences[:SHOWN]:
        joints = joint_list(tuple(sorted(j for j, _ in one.joints[:3])))
        lines.append(
            f"{effect_title(one.effect)} ({one.effect}{', ' + joints if joints else ''}): "
            f"{one.sessions} of {counted(one.looked, 'session')}, "
            f"{one.arms} of {counted(one.arms_looked, 'arm')}"
        )
    if not together.recurrences:
        lines.append("no effect is accused in any session")
    return lines + _unlike(together)


def _fitted_lines(together: Fitted) -> list[str]:
    lines = []
    for kind in together.types:
        shown = kind.scatter.identifiable
        spread = kind.scatter.between_arms[shown] / np.maximum(kind.scatter.mean[shown], 1e-12)
        before, after = (
            float(np.sqrt(np.mean([getattr(s, name) ** 2 for a in kind.arms for s in a.sessions])))
            for name in ("gap_before", "gap_held_out")
        )
        lines.append(
            f"{type_title(kind.name)}: {counted(len(kind.arms), 'arm')}, "
            f"{int(shown.sum())} of {len(shown)} flexibilities identifiable, scatter between arms "
            f"{_percent(spread)}; gap {with_unit(before, 'm')} with the cells, "
            f"{with_unit(after, 'm')} as predicted by the other sessions"
        )
    return lines + _unlike(together)


def _percent(spread: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> str:
    return f"{100 * float(np.median(spread)):.0f} %" if len(spread) else "not identifiable"


def _unlike(together: Diagnosed | Fitted) -> list[str]:
    lines = [
        f"drifts: {d.arm}, {quantity_title(d.quantity)}: {with_unit(d.slope, d.unit)} a {d.per}"
        for d in together.drifts[:SHOWN]
    ]
    lines += [
        f"stands out: {o.session or o.arm}, {quantity_title(o.quantity)}: "
        f"{with_unit(o.value, o.unit)}, usual {with_unit(o.usual, o.unit)}"
        for o in together.outliers[:SHOWN]
    ]
    return lines


def write_cells(found: Fitted, folder: Path) -> list[Path]:
    """Write a cell per arm and the table that names them; returns the paths, the table last.

    Each is the cell of the arm's last session; what the fleet does not show stays as it is there.
    """
    written: list[tuple[str, Path]] = []
    taken: set[str] = set()
    for kind in found.types:
        for arm in kind.arms:
            path = folder / f"{_file_name(arm.name, taken)}.yaml"
            _write(kind, arm, path)
            written.append((arm.name, path))
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("arm", "cell"))
    table.writerows((arm, path.name) for arm, path in written)
    write_text(folder / TABLE, text.getvalue())
    return [*(path for _, path in written), folder / TABLE]


def _write(kind: FittedType, arm: FittedArm, path: Path) -> None:
    cell = load_cell(Path(arm.sessions[-1].outcome.cell))
    values = np.where(kind.scatter.identifiable, arm.fit.flexibility, flexibilities(cell.model))
    n = cell.arm.n
    save_cell(cell, path, cell.model.with_compliance(values[:n], values[n:]))


def _file_name(arm: str, taken: set[str]) -> str:
    """Return a file name for an arm, none twice."""
    plain = re.sub(r"[^\w.-]+", "_", arm).strip(".") or "arm"
    name, count = plain, 1
    while name.lower() in taken:
        count += 1
        name = f"{plain}-{count}"
    taken.add(name.lower())
    return name


def write_parquet(
    path: Path, columns: Mapping[str, str], rows: Sequence[Mapping[str, Any]]
) -> Path:
    """Write rows under typed columns in one step; what a row lacks is null."""
    import pyarrow
    from pyarrow import parquet

    schema = pyarrow.schema([(name, _kind(pyarrow, kind)) for name, kind in columns.items()])
    table = pyarrow.Table.from_pylist(list(rows), schema=schema)
    with replacing_bytes(path) as file:
        parquet.write_table(table, file, compression="zstd")
    return path


def session_rows(outcomes: Sequence[Outcome]) -> Iterator[dict[str, Any]]:
    """Give a row per session, usable or not."""
    for outcome in outcomes:
        row = {name: getattr(outcome, name) for name in
               ("arm", "session", "log", "cell", "state", "error", "seconds",
                "processor")}  # fmt: skip
        names = ("type", "time", "poses", "joints")
        yield row | {name: outcome.result.get(name) for name in names}


def diagnosed_rows(outcomes: Sequence[Outcome]) -> Iterator[dict[str, Any]]:
    """Give a row per session with its channels' figures."""
    for row, outcome in zip(session_rows(outcomes), outcomes, strict=True):
        figures = {
            f"{channel['channel']}_{name}": channel[name]
            for channel in outcome.result.get("channels", ())
            for name in ("verdict", "samples", *FIGURES)
        }
        yield row | {"verdict": outcome.result.get("verdict")} | figures


def effect_rows(outcomes: Sequence[Outcome]) -> Iterator[dict[str, Any]]:
    """Give a row per session and parameter of an accused effect, and per effect looked at."""
    for outcome in outcomes:
        shared = {"arm": outcome.arm, "session": outcome.session,
                  "type": outcome.result.get("type"),
                  "time": outcome.result.get("time")}  # fmt: skip
        for row in outcome.result.get("rows", ()):
            yield shared | dict(row)


def _kind(pyarrow: Any, kind: str) -> Any:
    if kind.startswith("list<"):
        return pyarrow.list_(pyarrow.type_for_alias(kind[5:-1]))
    return pyarrow.type_for_alias(kind)
