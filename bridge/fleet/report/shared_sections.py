"""Sections that both reports have: drifts, outliers, sessions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gapbridge.bridge.report.fragment import (
    AFTER,
    Cell,
    Figure,
    Raw,
    badge,
    figure_block,
    html_of,
    paragraph,
    table,
)

from gapbridge.bridge.fleet.drift import Drift
from gapbridge.bridge.fleet.outlying import Outlier
from gapbridge.bridge.fleet.report.parameter_words import parameter_words
from gapbridge.bridge.fleet.runner import Done
from gapbridge.bridge.fleet.task import DONE, Outcome
from gapbridge.bridge.report.labels import number, unit_of, with_unit

MOST = 40  # rows of a table: the Parquet files have all
DRAWN = 6  # drifts in the picture
COLOURS = (AFTER, "#d9822b", "#2f9e62", "#8e5bb5", "#c43d3d", "#5b6770")
STATES = {"bad": "cannot be used", "crashed": "failed", "died": "took its workers along"}


def drifts(found: Sequence[Drift]) -> str:
    """Return the table of what drifts, and a picture of the surest."""
    if not found:
        return paragraph("Nothing drifts by more than sessions scatter anyway.")
    rows: list[list[Cell]] = [
        [
            Raw(f"<b>{html_of(d.arm)}</b>"), parameter_words(d.quantity),
            f"{with_unit(d.slope, d.unit)} a {d.per}", f"± {with_unit(d.std, d.unit)}",
            f"{with_unit(d.change, d.unit)} over {len(d.at)} sessions", _surely(d.p_value),
        ]
        for d in found[:MOST]
    ]  # fmt: skip
    heads = ("arm", "what", "changes by", "1 sigma", "in all", "by chance")
    return table(heads, rows) + _rest(len(found)) + figure_block(_drawn(found[:DRAWN]))


def _surely(p_value: float) -> str:
    return "under 1 in 10⁶" if p_value < 1e-6 else f"1 in {number(1 / p_value, 2)}"


def _drawn(found: Sequence[Drift]) -> Figure:
    """Return the surest drifts, each in its own 1 sigma about its first session."""
    traces: list[dict[str, Any]] = []
    for i, drift in enumerate(found):
        at, value = np.array(drift.at), np.array(drift.value)
        first = value[0]
        name, factor = unit_of(drift.unit)
        traces.append({
            "type": "scatter", "mode": "lines+markers",
            "name": f"{drift.arm}: {parameter_words(drift.quantity)}",
            "x": at + (0 if drift.per == "day" else 1),
            "y": (value - first) / max(abs(first), 1e-300) * 100,
            "customdata": value * factor, "text": list(drift.sessions),
            "hovertemplate": f"%{{text}}: %{{customdata:.4g}} {name}<extra></extra>",
            "line": {"color": COLOURS[i % len(COLOURS)], "width": 2}, "marker": {"size": 6},
        })  # fmt: skip
    per = {d.per for d in found}
    title = "days since the first session" if per == {"day"} else "session of the arm"
    return Figure(
        traces,
        {"xaxis": {"title": {"text": title}} | ({} if per == {"day"} else {"dtick": 1}),
         "showlegend": True,
         "yaxis": {"title": {"text": "change since the first session (%)"}},
         "legend": {"orientation": "h", "y": -0.22, "x": 0, "yanchor": "top"},
         "margin": {"l": 60, "r": 16, "t": 16, "b": 40}},
        "The surest drifts. Point at a session for its value.", 420,
    )  # fmt: skip


def outliers(found: Sequence[Outlier]) -> str:
    """Return the table of what stands out."""
    if not found:
        return paragraph("No arm and no session is far from the others.")
    rows: list[list[Cell]] = [
        [
            Raw(f"<b>{unbroken(o.arm).html}</b>"), unbroken(_short(o)), parameter_words(o.what),
            unbroken(with_unit(o.value, o.unit)), unbroken(with_unit(o.usual, o.unit)),
            f"{abs(o.deviations):.1f}",
        ]
        for o in found[:MOST]
    ]  # fmt: skip
    heads = ("arm", "session", "what", "found", "usual", "deviations away")
    return table(heads, rows) + _rest(len(found))


def _short(outlier: Outlier) -> str:
    return outlier.session.removeprefix(f"{outlier.arm}/") or "all"


def sessions(done: Done, heads: Sequence[str], cells: Callable[[Outcome], Sequence[Cell]]) -> str:
    """Return the sessions that were skipped, with the reason, and a table of the others."""
    bad = [o for o in done.outcomes if o.state != DONE]
    good = [o for o in done.outcomes if o.state == DONE]
    parts = []
    rows: list[list[Cell]]
    if bad:
        parts.append(f"<h3>Skipped ({len(bad)})</h3>")
        rows = [[*_whose(o), badge(STATES[o.state], "bad"), o.error] for o in bad[:MOST]]
        parts += [table(("arm", "session", "state", "why"), rows), _rest(len(bad))]
        parts.append(f"<h3>Used ({len(good)})</h3>")
    rows = [[*_whose(o), *cells(o)] for o in good[:MOST]]
    parts += [table(("arm", "session", *heads), rows), _rest(len(good))]
    return "".join(parts)


def _whose(outcome: Outcome) -> tuple[Cell, Cell]:
    name = outcome.session.removeprefix(f"{outcome.arm}/")
    return Raw(f"<b>{unbroken(outcome.arm).html}</b>"), unbroken(name)


def unbroken(text: str) -> Raw:
    """Return a text that stays on one line."""
    return Raw(f'<span style="white-space:nowrap">{html_of(text)}</span>')


def _rest(count: int) -> str:
    if count <= MOST:
        return ""
    return paragraph(f"{count - MOST} more are in results.parquet and sessions.parquet.", "note")
