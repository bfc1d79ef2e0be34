"""Sections that both reports have: drifts, outliers, sessions, origin."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.axes import Chart, scale
from gapbridge.bridge.document.drawing import AFTER, BAD_DOT, BEFORE, LIMIT, SOFT, VIOLET, Drawing
from gapbridge.bridge.document.numbers import number, with_unit
from gapbridge.bridge.fleet.drift import ChannelFigure, Drift, Outlier, Quantity
from gapbridge.bridge.fleet.runner import STATES, FleetRun
from gapbridge.bridge.fleet.task import DONE, Outcome
from gapbridge.bridge.report.labels import CHANNELS, parameter_title

MAX_ROWS = 40  # rows of a table; all are in the Parquet files
MAX_DRAWN = 6  # drifts in the picture
COLOURS = (AFTER, BEFORE, LIMIT, VIOLET, BAD_DOT, SOFT)


def quantity_title(quantity: Quantity) -> str:
    """Return the title of a quantity that drifts or is an outlier."""
    if isinstance(quantity, ChannelFigure):
        return f"{CHANNELS[quantity.channel].lower()}: {quantity.figure.value}"
    return parameter_title(quantity)


def type_title(name: str) -> str:
    """Return the title of an arm type; that of DH rows is a hash."""
    kind, _, rest = name.partition(" ")
    return f"Arms of DH rows ({rest})" if kind == "dh" and rest else name


def drifts(found: Sequence[Drift]) -> list[blocks.Block]:
    """Return the table of drifts, and a picture of the most significant."""
    if not found:
        return [blocks.Paragraph("No quantity drifts significantly.")]
    rows: list[list[blocks.Cell]] = [
        [
            blocks.Strong(d.arm), quantity_title(d.quantity),
            f"{with_unit(d.slope, d.unit)} a {d.per}", f"± {with_unit(d.std, d.unit)}",
            f"{with_unit(d.change, d.unit)} over {len(d.times)} sessions", _by_chance(d.p_value),
        ]
        for d in found[:MAX_ROWS]
    ]  # fmt: skip
    heads = ("arm", "what", "slope", "1 sigma", "total", "by chance")
    picture = blocks.Pictures((_drift_chart(found[:MAX_DRAWN]),), "The most significant drifts.")
    return [blocks.Table(heads, rows), *_more_note(len(found)), picture]


def _by_chance(p_value: float) -> str:
    return "under 1 in 10⁶" if p_value < 1e-6 else f"1 in {number(1 / p_value, 2)}"


def _drift_chart(found: Sequence[Drift]) -> Drawing:
    """Return a chart of drifts: changes since the first session, which can be at zero."""
    per_day = {d.per for d in found} == {"day"}
    x = [np.array(d.times) + (0 if d.per == "day" else 1) for d in found]
    y = [
        (np.array(d.value) - d.value[0]) / (max(map(abs, d.value)) or 1.0) * 100 for d in found
    ]  # fmt: skip
    chart = Chart(
        "Change since the first session",
        scale("days since the first session" if per_day else "session of the arm",
              [v for one in x for v in one], zero=False),
        scale("change, % of the largest value", [v for one in y for v in one]),
        width=430, height=260,
    )  # fmt: skip
    for drift, times, change, colour in zip(found, x, y, COLOURS, strict=False):
        chart.line([*times], [*change], colour)
        hints = [
            f"{session}: {with_unit(value, drift.unit)}"
            for session, value in zip(drift.sessions, drift.value, strict=True)
        ]
        chart.points([*times], [*change], colour, hints=hints)
    chart.legend_below(
        [(f"{d.arm}: {quantity_title(d.quantity)}", c)
         for d, c in zip(found, COLOURS, strict=False)]
    )  # fmt: skip
    return chart.drawing


def outliers(found: Sequence[Outlier]) -> list[blocks.Block]:
    """Return the table of outliers."""
    if not found:
        return [blocks.Paragraph("No arm and no session is an outlier.")]
    rows: list[list[blocks.Cell]] = [
        [
            blocks.Strong(o.arm), _short(o.session, o.arm) or "all", quantity_title(o.quantity),
            with_unit(o.value, o.unit), with_unit(o.usual, o.unit), f"{abs(o.deviations):.1f}",
        ]
        for o in found[:MAX_ROWS]
    ]  # fmt: skip
    heads = ("arm", "session", "what", "value", "usual", "deviations")
    return [blocks.Table(heads, rows, numbers=(3, 4, 5)), *_more_note(len(found))]


def sessions(
    done: FleetRun, heads: Sequence[str], cells: Callable[[Outcome], Sequence[blocks.Cell]]
) -> list[blocks.Block]:
    """Return the sessions that were skipped, with the reason, and a table of the others."""
    bad = [o for o in done.outcomes if o.state != DONE]
    good = [o for o in done.outcomes if o.state == DONE]
    content: list[blocks.Block] = []
    if bad:
        rows = [
            [*_names(o), blocks.Badge(STATES[o.state], blocks.BAD), o.error] for o in bad[:MAX_ROWS]
        ]
        skipped = blocks.Table(("arm", "session", "state", "why"), rows, (1, 1, 1, 4))
        content += [blocks.Heading(f"Skipped ({len(bad)})"), skipped, *_more_note(len(bad))]
        content.append(blocks.Heading(f"Used ({len(good)})"))
    used = [[*_names(o), *cells(o)] for o in good[:MAX_ROWS]]
    return [*content, blocks.Table(("arm", "session", *heads), used), *_more_note(len(good))]


def _names(outcome: Outcome) -> tuple[blocks.Cell, blocks.Cell]:
    return blocks.Strong(outcome.arm), _short(outcome.session, outcome.arm)


def _short(session: str, arm: str) -> str:
    """Return the name of a session relative to its arm."""
    return session.removeprefix(f"{arm}/")


def _more_note(count: int) -> list[blocks.Block]:
    if count <= MAX_ROWS:
        return []
    more = f"{count - MAX_ROWS} more are in results.parquet and sessions.parquet."
    return [blocks.Paragraph(more, "note")]
