"""Writes what a run has found: tables, report, cells; returns the lines for the terminal."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gapbridge.bridge.fleet import tables
from gapbridge.bridge.fleet.applying import write_cells
from gapbridge.bridge.fleet.diagnosis_summary import Diagnosed, diagnosed
from gapbridge.bridge.fleet.ending import counted
from gapbridge.bridge.fleet.fit_summary import Fitted, fitted, rows, session_figures
from gapbridge.bridge.fleet.report.page import write_diagnosed_report, write_fitted_report
from gapbridge.bridge.fleet.report.shared_sections import quantity_title, type_title
from gapbridge.bridge.fleet.runner import Done
from gapbridge.bridge.fleet.session import Found
from gapbridge.bridge.report.labels import effect_title, joint_list, with_unit

SHOWN = 8  # lines of a kind on the terminal; all are in the tables


def write_diagnosed(done: Done, found: Found, folder: Path) -> tuple[list[str], list[Path]]:
    """Write the results of ``fleet diagnose``; returns lines for the terminal, and the files."""
    together = diagnosed(done.outcomes)
    files = [
        tables.write_parquet(
            folder / tables.RESULTS, tables.EFFECT, list(tables.effect_rows(done.outcomes))
        ),
        tables.write_parquet(
            folder / tables.SESSIONS, tables.DIAGNOSED, list(tables.diagnosed_rows(done.outcomes))
        ),
        write_diagnosed_report(together, done, found, folder),
    ]
    return _diagnosed_lines(together), files


def write_fitted(
    done: Done, found: Found, folder: Path, cells: Path | None
) -> tuple[list[str], list[Path]]:
    """Write the results of ``fleet fit``, and the cells where they are wanted."""
    together = fitted(done.outcomes)
    figures = session_figures(together)
    sessions = [row | figures.get(row["session"], {}) for row in tables.session_rows(done.outcomes)]
    files = [
        tables.write_parquet(folder / tables.RESULTS, tables.FLEXIBILITY, list(rows(together))),
        tables.write_parquet(folder / tables.SESSIONS, tables.FITTED, sessions),
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
        shown = kind.scatter.shown
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
