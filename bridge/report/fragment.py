"""Fragments of the page: paragraphs, tables, bars and figures; all text is escaped here."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

BEFORE, AFTER, FLOOR = "#d9822b", "#1f77b4", "#9aa5b1"
GRID, ZERO = "#e8ecf0", "#c9d1d8"
EXPLAINED, LEFT = "#2f9e62", "#c43d3d"
FONT = {"family": "system-ui, -apple-system, Segoe UI, Roboto, sans-serif", "size": 13}


@dataclass(frozen=True)
class Raw:
    """Markup that is already safe."""

    html: str


Cell = str | Raw


@dataclass(frozen=True)
class Choice:
    """Something a figure's axis can show instead: a value per point of every trace."""

    label: str
    title: str  # of the axis
    values: Sequence[NDArray[np.float64]]  # per trace


@dataclass(frozen=True)
class Figure:
    """One interactive figure: plotly's traces and layout, and what its axes may show instead."""

    traces: Sequence[Mapping[str, Any]]
    layout: Mapping[str, Any]
    caption: str
    height: int = 360
    choices: Mapping[str, Sequence[Choice]] = field(default_factory=dict)  # axis "x" or "y"


def html_of(cell: Cell) -> str:
    """Return markup of a text or of markup."""
    return cell.html if isinstance(cell, Raw) else escape(cell)


def paragraph(text: Cell, css: str = "") -> str:
    """Return a paragraph."""
    return f"<p{_css(css)}>{html_of(text)}</p>"


def heading(text: str) -> str:
    """Return a heading inside a section."""
    return f"<h3>{escape(text)}</h3>"


def bullets(items: Iterable[Cell]) -> str:
    """Return a list; nothing for no items."""
    rows = "".join(f"<li>{html_of(item)}</li>" for item in items)
    return f"<ul>{rows}</ul>" if rows else ""


def table(heads: Sequence[str], rows: Iterable[Sequence[Cell]]) -> str:
    """Return a table that scrolls sideways where the screen is narrow."""
    head = "".join(f"<th>{escape(h)}</th>" for h in heads)
    body = "".join(
        "<tr>"
        # the label stands beside the cell where a phone shows each row as a card
        + "".join(
            f'<td data-label="{escape(h)}"><div>{html_of(c)}</div></td>'
            for h, c in zip(heads, cells, strict=True)
        )
        + "</tr>"
        for cells in rows
    )
    kind = ' class="cards"' if len(heads) > 3 else ""
    return (
        f'<div class="wide"><table{kind}><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def bar(share: float | None, text: str, colour: str = AFTER) -> Raw:
    """Return a small bar for a share of 0 to 1, with its figure beside it."""
    width = 0.0 if share is None or not math.isfinite(share) else min(max(share, 0.0), 1.0)
    return Raw(
        f'<span class="share"><span class="bar"><i style="width:{width * 100:.0f}%;'
        f'background:{colour}"></i></span>{escape(text)}</span>'
    )


def badge(text: str, kind: str) -> Raw:
    """Return a short word on a coloured ground; ``kind`` is good, doubtful, bad or quiet."""
    return Raw(f'<span class="badge {kind}">{escape(text)}</span>')


def figure_block(figure: Figure) -> str:
    """Return a figure with its caption and the menus of its axes."""
    layout: dict[str, Any] = {
        "font": FONT, "margin": {"l": 60, "r": 16, "t": 16, "b": 48}, "autosize": True,
        "height": figure.height, "paper_bgcolor": "rgba(0,0,0,0)", "hovermode": "closest",
        "plot_bgcolor": "rgba(0,0,0,0)", "legend": {"orientation": "h", "y": 1.02, "x": 0,
        "yanchor": "bottom"}, **figure.layout,
    }  # fmt: skip
    for axis in ("xaxis", "yaxis"):
        layout[axis] = {"gridcolor": GRID, "zerolinecolor": ZERO, **layout.get(axis, {})}
    choices = {
        axis: [{"label": c.label, "title": c.title, "values": c.values} for c in given]
        for axis, given in figure.choices.items()
    }
    data = json_text({"data": figure.traces, "layout": layout, "choices": choices})
    menus = "".join(
        f'<label>{"Against" if axis == "x" else "Show"} <select data-axis="{axis}">'
        + "".join(f'<option value="{i}">{escape(c.label)}</option>' for i, c in enumerate(given))
        + "</select></label>"
        for axis, given in figure.choices.items() if len(given) > 1
    )  # fmt: skip
    menu = f'<div class="menus">{menus}</div>' if menus else ""
    return (
        f'<figure>{menu}<div class="plot" style="min-height:{figure.height}px">'
        f'<script type="application/json">{data}</script></div>'
        f"<figcaption>{escape(figure.caption)}</figcaption></figure>"
    )


def json_text(value: Any) -> str:
    """Return JSON that may stand inside a script element; what is no number becomes null."""
    text = json.dumps(_plain(value), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", " ").replace("\u2029", " ")


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float | np.floating):
        # five digits are more than a screen shows, and keep the file small
        return float(f"{value:.5g}") if math.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value


def _css(css: str) -> str:
    return f' class="{css}"' if css else ""
