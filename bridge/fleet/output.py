"""Writes the results of a run: Parquet tables, report, cells and lines for the terminal."""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.saving import cell_text
from gapbridge.bridge.document.numbers import percent, with_unit
from gapbridge.bridge.document.output_file import write_text, write_together
from gapbridge.bridge.document.provenance import fitted, intervals_of, provenance
from gapbridge.bridge.fleet.diagnosis_summary import FleetDiagnosis, summarise
from gapbridge.bridge.fleet.fit_summary import (
    FittedArm,
    FittedType,
    FleetFit,
    fit_fleet,
    flexibility_rows,
    session_figures,
)
from gapbridge.bridge.fleet.report.page import diagnosis_report, fit_report
from gapbridge.bridge.fleet.report.shared_sections import quantity_title, type_title
from gapbridge.bridge.fleet.runner import FleetRun
from gapbridge.bridge.fleet.session import (
    CELL_TABLE,
    REPORT_FILE,
    RESULTS_FILE,
    SESSIONS_FILE,
    Fleet,
)
from gapbridge.bridge.fleet.task import Outcome
from gapbridge.bridge.report.labels import counted, effect_title, joint_list
from gapbridge.core.calibration.spread import Spread
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.flexibilities import flexibilities
from gapbridge.core.fitted_range import merged

SHOWN = 8  # lines of each kind on the terminal
CHANNELS = ("position", "wrench", "tracking", "torque")
FIGURE_COLUMNS = {"gap_rms": "float64", "gap_max": "float64", "noise_floor_rms": "float64",
           "remaining_rms": "float64", "remaining_rms_held_out": "float64"}  # fmt: skip
SESSION_COLUMNS = {
    "arm": "string", "session": "string", "type": "string", "log": "string", "cell": "string",
    "state": "string", "error": "string", "seconds": "float64", "processor": "float64",
    "time": "float64", "poses": "int64", "joints": "int64",
}  # fmt: skip
EFFECT_COLUMNS = {
    "arm": "string", "session": "string", "type": "string", "time": "float64",
    "channel": "string", "effect": "string", "accused": "bool", "joints": "list<int64>",
    "parameter": "string", "value": "float64", "std": "float64", "unit": "string",
    "probability": "float64", "shrink": "float64", "shrink_low": "float64",
    "shrink_high": "float64", "shrink_alone": "float64",
    "indistinguishable_from": "list<string>",
}  # fmt: skip
DIAGNOSIS_COLUMNS = {
    **SESSION_COLUMNS, "verdict": "string",
    **{f"{c}_{f}": kind for c in CHANNELS
       for f, kind in {"verdict": "string", "samples": "int64", **FIGURE_COLUMNS}.items()},
}  # fmt: skip
FLEXIBILITY_COLUMNS = {
    "level": "string", "type": "string", "arm": "string", "session": "string",
    "parameter": "string", "joint": "int64", "value": "float64", "std": "float64",
    "low": "float64", "high": "float64", "unit": "string", "shown": "bool",
    "scatter": "float64", "own_share": "float64", "drift": "float64", "drift_std": "float64",
    "drift_per": "string",
}  # fmt: skip
FIT_COLUMNS = {
    **SESSION_COLUMNS, "outliers": "int64", "noise": "float64", "gap_before": "float64",
    "gap_after": "float64", "gap_held_out": "float64", "surprise": "float64",
}  # fmt: skip


def write_diagnosis(done: FleetRun, fleet: Fleet, folder: Path) -> tuple[list[str], list[Path]]:
    """Write the results of ``fleet diagnose``; returns lines for the terminal, and the files."""
    summary = summarise(done.outcomes)
    files = write_together({
        folder / RESULTS_FILE: parquet(EFFECT_COLUMNS, list(effect_rows(done.outcomes))),
        folder / SESSIONS_FILE: parquet(DIAGNOSIS_COLUMNS, list(diagnosis_rows(done.outcomes))),
        folder / REPORT_FILE: diagnosis_report(summary, done, fleet),
    })  # fmt: skip
    return _diagnosis_lines(summary), files


def write_fit(
    done: FleetRun, fleet: Fleet, folder: Path, cells: Path | None
) -> tuple[list[str], list[Path]]:
    """Write the results of ``fleet fit``, and the cells if ``cells`` names a folder."""
    summary = fit_fleet(done.outcomes)
    figures = session_figures(summary)
    sessions = [row | figures.get(row["session"], {}) for row in session_rows(done.outcomes)]
    files = write_together({
        folder / RESULTS_FILE: parquet(FLEXIBILITY_COLUMNS, list(flexibility_rows(summary))),
        folder / SESSIONS_FILE: parquet(FIT_COLUMNS, sessions),
        folder / REPORT_FILE: fit_report(summary, done, fleet),
    })  # fmt: skip
    if cells is not None:
        files.append(write_cells(summary, cells)[-1])
    return _fit_lines(summary), files


def _diagnosis_lines(summary: FleetDiagnosis) -> list[str]:
    lines = []
    for one in summary.recurrences[:SHOWN]:
        joints = joint_list(tuple(sorted(j for j, _ in one.joints[:3])))
        lines.append(
            f"{effect_title(one.effect)} ({one.effect}{', ' + joints if joints else ''}): "
            f"{one.sessions} of {counted(one.observable, 'session')}, "
            f"{one.arms} of {counted(one.arms_observable, 'arm')}"
        )
    if not summary.recurrences:
        lines.append("no effect is named in any session")
    return lines + _drift_and_outlier_lines(summary)


def _fit_lines(summary: FleetFit) -> list[str]:
    lines = []
    for kind in summary.types:
        shown = kind.scatter.identifiable
        before, after = (
            float(np.sqrt(np.mean([getattr(s, name) ** 2 for a in kind.arms for s in a.sessions])))
            for name in ("gap_before", "gap_held_out")
        )
        lines.append(
            f"{type_title(kind.name)}: {counted(len(kind.arms), 'arm')}, "
            f"{int(shown.sum())} of {len(shown)} flexibilities identifiable, scatter between arms "
            f"{percent(kind.spread)}; gap {with_unit(before, 'm')} with the cells, "
            f"{with_unit(after, 'm')} as predicted by the other sessions"
        )
    return lines + _drift_and_outlier_lines(summary)


def _drift_and_outlier_lines(summary: FleetDiagnosis | FleetFit) -> list[str]:
    lines = [
        f"drift: {d.arm}, {quantity_title(d.quantity)}: {with_unit(d.slope, d.unit)} a {d.per}"
        for d in summary.drifts[:SHOWN]
    ]
    lines += [
        f"outlier: {o.session or o.arm}, {quantity_title(o.quantity)}: "
        f"{with_unit(o.value, o.unit)}, usual {with_unit(o.usual, o.unit)}"
        for o in summary.outliers[:SHOWN]
    ]
    return lines


def write_cells(fit: FleetFit, folder: Path) -> list[Path]:
    """Write a cell per arm and the table of them; returns the paths, the table last.

    Each is the cell of the arm's last session; flexibilities not identified are kept. Raises
    RunError, before the first is written, where one could not be loaded.
    """
    arms = [(kind, arm) for kind in fit.types for arm in kind.arms]
    paths = cell_paths(folder, [arm.name for _, arm in arms])
    texts = [_cell_text(kind, arm, path) for (kind, arm), path in zip(arms, paths, strict=True)]
    for path, cell in zip(paths, texts, strict=True):
        write_text(path, cell)
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(("arm", "cell"))
    table.writerows((arm.name, path.name) for (_, arm), path in zip(arms, paths, strict=True))
    write_text(folder / CELL_TABLE, text.getvalue())
    return [*paths, folder / CELL_TABLE]


def cell_paths(folder: Path, arms: Sequence[str]) -> list[Path]:
    """Return the path of each arm's new cell."""
    used: set[str] = set()
    return [folder / f"{_file_name(arm, used)}.yaml" for arm in arms]


def require_no_input(folder: Path, arms: Sequence[str], inputs: Iterable[Path]) -> None:
    """Raise InputError if a new cell, or the table of them, would replace an input.

    A night without logs of some arms would else drop those from the table of the next.
    """
    known = {os.path.realpath(path): path for path in inputs}  # links are followed
    for path in (folder / CELL_TABLE, *cell_paths(folder, arms)):
        if (found := known.get(os.path.realpath(path))) is not None:
            raise InputError(
                f"{path}: found the output to be the input {found}, expected another folder for "
                "--apply"
            )


def _cell_text(kind: FittedType, arm: FittedArm, path: Path) -> str:
    last, known = arm.sessions[-1].outcome, kind.scatter.identifiable
    cell = load_cell(Path(last.cell))
    values = np.where(known, arm.fit.flexibility, flexibilities(cell.model))
    n = cell.arm.n
    logs = [Path(s.outcome.log) for s in arm.sessions]
    ranges = merged(s.outcome.result.get("range", {}) for s in arm.sessions)
    spread = Spread.of_fit(known, arm.fit.covariance).beside(cell.spread)
    estimates = zip(kind.parameters, values, arm.fit.std, known, strict=True)
    intervals = intervals_of((name, float(v), float(std)) for name, v, std, k in estimates if k)
    origin = provenance({"log": logs, "cell": [Path(last.cell)]})
    origin = fitted(origin, ranges, spread, cell.intervals | intervals)
    model = cell.model.with_compliance(values[:n], values[n:])
    return cell_text(cell, path, model, {"provenance": origin})


def _file_name(arm: str, used: set[str]) -> str:
    """Return a unique file name for an arm."""
    plain = re.sub(r"[^\w.-]+", "_", arm).strip(".") or "arm"
    name, count = plain, 1
    while name.lower() in used:
        count += 1
        name = f"{plain}-{count}"
    used.add(name.lower())
    return name


def parquet(columns: Mapping[str, str], rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Return rows with typed columns as a Parquet file; missing values are null."""
    import pyarrow
    from pyarrow.parquet import write_table

    schema = pyarrow.schema([(name, _arrow_type(pyarrow, kind)) for name, kind in columns.items()])
    table = pyarrow.Table.from_pylist(list(rows), schema=schema)
    file = io.BytesIO()
    write_table(table, file, compression="zstd")
    return file.getvalue()


def session_rows(outcomes: Sequence[Outcome]) -> Iterator[dict[str, Any]]:
    """Yield a row per session, usable or not."""
    for outcome in outcomes:
        row = {name: getattr(outcome, name) for name in
               ("arm", "session", "log", "cell", "state", "error", "seconds",
                "processor")}  # fmt: skip
        names = ("type", "time", "poses", "joints")
        yield row | {name: outcome.result.get(name) for name in names}


def diagnosis_rows(outcomes: Sequence[Outcome]) -> Iterator[dict[str, Any]]:
    """Yield a row per session with the figures of its channels."""
    for row, outcome in zip(session_rows(outcomes), outcomes, strict=True):
        figures = {
            f"{channel['channel']}_{name}": channel[name]
            for channel in outcome.result.get("channels", ())
            for name in ("verdict", "samples", *FIGURE_COLUMNS)
        }
        yield row | {"verdict": outcome.result.get("verdict")} | figures


def effect_rows(outcomes: Sequence[Outcome]) -> Iterator[dict[str, Any]]:
    """Yield a row per session and parameter of a named cause, and per other effect tried."""
    for outcome in outcomes:
        shared = {"arm": outcome.arm, "session": outcome.session,
                  "type": outcome.result.get("type"),
                  "time": outcome.result.get("time")}  # fmt: skip
        for row in outcome.result.get("rows", ()):
            yield shared | dict(row)


def _arrow_type(pyarrow: Any, kind: str) -> Any:
    if kind.startswith("list<"):
        return pyarrow.list_(pyarrow.type_for_alias(kind[5:-1]))
    return pyarrow.type_for_alias(kind)
