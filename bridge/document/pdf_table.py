"""Tables of the PDF: rows and columns, large figures, pairs."""

from __future__ import annotations

from typing import Any

from reportlab.lib.colors import HexColor
from reportlab.platypus import Flowable, Paragraph, TableStyle
from reportlab.platypus import Table as Grid

from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.drawing import PALETTE
from gapbridge.bridge.document.pdf_text import STYLES, badge_markup, markup

LINE, RULE = HexColor("#e3e8ec"), HexColor("#9aa5b1")
Command = tuple[str, tuple[int, int], tuple[int, int], *tuple[Any, ...]]
BAR = 38.0  # pt, a full bar


def table(block: blocks.Table, width: float) -> Flowable:
    """Return a table whose head is repeated on every page."""
    shares = block.widths or (1.0,) * len(block.heads)
    widths = [width * share / sum(shares) for share in shares]
    heads = [
        Paragraph(markup(h), STYLES["head_number" if i in block.numbers else "head"])
        for i, h in enumerate(block.heads)
    ]
    first_sum = len(block.rows) - block.sums
    rows = [
        [_cell(c, i in block.numbers, number >= first_sum) for i, c in enumerate(cells)]
        for number, cells in enumerate(block.rows)
    ]
    style: list[Command] = [
        ("VALIGN", (0, 0), (-1, -1), "TOP"), ("VALIGN", (0, 0), (-1, 0), "BOTTOM"),
        ("LINEBELOW", (0, 0), (-1, 0), 0.8, RULE),
        ("LINEBELOW", (0, 1), (-1, -1), 0.4, LINE),
        ("LEFTPADDING", (0, 0), (-1, -1), 0), ("RIGHTPADDING", (0, 0), (-1, -1), 6),
        ("TOPPADDING", (0, 0), (-1, -1), 2.5), ("BOTTOMPADDING", (0, 0), (-1, -1), 2.5),
    ]  # fmt: skip
    if block.sums:
        style.append(("LINEABOVE", (0, first_sum + 1), (-1, first_sum + 1), 0.8, RULE))
    return Grid([heads, *rows], widths, repeatRows=1, style=TableStyle(style))


def tiles_table(block: blocks.Tiles, width: float) -> Flowable:
    """Return large figures in boxes, four in a row."""
    rows = [block.tiles[i : i + 4] for i in range(0, len(block.tiles), 4)]
    cells = [
        [
            [
                Paragraph(markup(t.label), STYLES["tile_label"]),
                Paragraph(markup(t.value), STYLES["tile_value"]),
                Paragraph(markup(t.note), STYLES["tile_label"]),
            ]
            for t in row
        ]
        + [""] * (min(4, len(block.tiles)) - len(row))
        for row in rows
    ]
    columns = len(cells[0])
    style: list[Command] = [
        ("VALIGN", (0, 0), (-1, -1), "TOP"), ("LEFTPADDING", (0, 0), (-1, -1), 7),
        ("TOPPADDING", (0, 0), (-1, -1), 5), ("BOTTOMPADDING", (0, 0), (-1, -1), 5),
    ]  # fmt: skip
    for number, row in enumerate(rows):
        style.append(("GRID", (0, number), (len(row) - 1, number), 0.6, LINE))
    return Grid(cells, [width / columns] * columns, style=TableStyle(style))


def table_row(block: blocks.TableRow, width: float) -> Flowable:
    """Return small tables in a row."""
    each = width / len(block.tables)
    style: list[Command] = [
        ("VALIGN", (0, 0), (-1, -1), "TOP"),
        ("LEFTPADDING", (0, 0), (-1, -1), 0),
    ]
    cells = [table(t, each - 14) for t in block.tables]
    return Grid([cells], [each] * len(cells), style=TableStyle(style))


def columns_table(block: blocks.Columns, width: float) -> Flowable:
    """Return pairs in columns."""
    each = width / len(block.columns)
    cells = [
        [Paragraph(markup(p.title), STYLES["h3"]), _pairs(p, each - 14)] if p.title else
        [_pairs(p, each - 14)]
        for p in block.columns
    ]  # fmt: skip
    style: list[Command] = [
        ("VALIGN", (0, 0), (-1, -1), "TOP"), ("LEFTPADDING", (0, 0), (-1, -1), 0),
        ("TOPPADDING", (0, 0), (-1, -1), 0), ("BOTTOMPADDING", (0, 0), (-1, -1), 2),
    ]  # fmt: skip
    return Grid([cells], [each] * len(cells), style=TableStyle(style))


def _pairs(block: blocks.Pairs, width: float) -> Flowable:
    rows = [
        [Paragraph(markup(k), STYLES["name"]), Paragraph(markup(v), STYLES["cell"])]
        for k, v in block.pairs
    ]
    style = [
        ("VALIGN", (0, 0), (-1, -1), "TOP"), ("LEFTPADDING", (0, 0), (-1, -1), 0),
        ("TOPPADDING", (0, 0), (-1, -1), 1.5), ("BOTTOMPADDING", (0, 0), (-1, -1), 1.5),
    ]  # fmt: skip
    return Grid(rows, [width * 0.34, width * 0.66], style=TableStyle(style))


def _cell(cell: blocks.Cell, number: bool, strong: bool) -> Flowable:
    if isinstance(cell, blocks.Bar):
        return _Bar(cell)
    if isinstance(cell, blocks.Badge):
        return Paragraph(badge_markup(cell), STYLES["cell"])
    if isinstance(cell, blocks.Named):
        name = f"<b>{markup(cell.text)}</b>{markup(cell.more)}" if cell.text else ""
        code = f'<font color="#5b6770">{markup(cell.code)}</font>' if cell.code else ""
        return Paragraph(f"{name}{'<br/>' if name and code else ''}{code}", STYLES["cell"])
    text = markup(cell.text if isinstance(cell, blocks.Strong) else cell)
    if strong or isinstance(cell, blocks.Strong):
        text = f"<b>{text}</b>"
    return Paragraph(text, STYLES["number" if number else "cell"])


class _Bar(Flowable):
    """A share as a bar, followed by its figure."""

    def __init__(self, bar: blocks.Bar) -> None:
        super().__init__()
        self.share, self.colour = bar.filled, HexColor(PALETTE[bar.colour])
        self.text = Paragraph(markup(bar.text), STYLES["cell"])

    def wrap(self, available_width: float, available_height: float) -> tuple[float, float]:
        """Return the size that the bar takes, pt."""
        self.text.wrap(max(available_width - BAR - 5, 20), available_height)
        return available_width, float(self.text.height)

    def draw(self) -> None:
        """Draw the bar on the canvas that the page gives."""
        middle = self.text.height - 7.5
        self.canv.setFillColor(HexColor("#eef1f4"))
        self.canv.rect(0, middle, BAR, 5, 0, 1)
        self.canv.setFillColor(self.colour)
        self.canv.rect(0, middle, BAR * self.share, 5, 0, 1)
        self.text.drawOn(self.canv, BAR + 5, 0)
