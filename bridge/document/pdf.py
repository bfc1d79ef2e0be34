"""Write a document as a PDF: A4, embedded font, numbered pages."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from functools import cache
from html import escape
from importlib.resources import as_file, files
from typing import Any

from reportlab.lib.colors import HexColor
from reportlab.lib.pagesizes import A4
from reportlab.lib.styles import ParagraphStyle
from reportlab.lib.units import mm
from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.cidfonts import UnicodeCIDFont
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.pdfgen.canvas import Canvas
from reportlab.platypus import (
    BaseDocTemplate,
    CondPageBreak,
    Flowable,
    Frame,
    KeepTogether,
    PageTemplate,
    Paragraph,
    Spacer,
    TableStyle,
)
from reportlab.platypus import Table as Grid

from gapbridge.bridge.document import blocks
from gapbridge.bridge.document import drawing as drawn
from gapbridge.bridge.document.blocks import Badge
from gapbridge.bridge.document.drawing import PALETTE
from gapbridge.bridge.document.output_file import printable

SIDE, TOP, BOTTOM = 18 * mm, 16 * mm, 18 * mm
WIDTH = A4[0] - 2 * SIDE
MIN_SPACE = 120  # pt, for a heading and the first rows of a long table
GAP, LARGEST_SCALE = 16.0, 0.76  # between drawings in a row, pt; and of them
MAX_UNSPLIT_ROWS = 14  # of a table that is kept on one page
LINE, RULE = HexColor("#e3e8ec"), HexColor("#9aa5b1")
Command = tuple[str, tuple[int, int], tuple[int, int], *tuple[Any, ...]]
BAR = 38.0  # pt, a full bar
PLAIN, BOLD = "Gapbridge", "Gapbridge-Bold"
HAN, KANA, HANGUL = "STSong-Light", "HeiseiKakuGo-W5", "HYGothic-Medium"
_HANGUL, _HAN = r"\u1100-\u11ff\uac00-\ud7af", r"\u2e80-\u9fff\uf900-\ufaff\uff00-\uffef"
_RUNS = re.compile(f"[{_HANGUL}]+|[{_HAN}]+|[^{_HANGUL}{_HAN}]+")
INK, SOFT = HexColor("#1c2730"), HexColor("#5b6770")
BADGE_COLOURS = {"good": ("#e2f4e9", "#1d6b42"), "doubtful": ("#fdf0d9", "#8a5a0b"),
           "bad": ("#fbe3e3", "#982a2a"), "quiet": ("#eef1f4", "#4d5962")}  # fmt: skip

_TEXT = ParagraphStyle("text", fontName=PLAIN, fontSize=9, leading=12.5, textColor=INK,
                       spaceAfter=5)  # fmt: skip


class DrawnRow(Flowable):
    """Drawings in a row, scaled down together where they are wider than the page."""

    def __init__(self, drawings: tuple[drawn.Drawing, ...]) -> None:
        super().__init__()
        self.drawings, self.scale = drawings, LARGEST_SCALE

    def wrap(self, available_width: float, available_height: float) -> tuple[float, float]:
        """Return the size that the row takes, pt."""
        gaps = GAP * (len(self.drawings) - 1)
        wanted = sum(d.width for d in self.drawings)
        self.scale = min(self.scale, (available_width - gaps) / wanted)
        return available_width, max(d.height for d in self.drawings) * self.scale + 4

    def draw(self) -> None:
        """Draw the row on the canvas that the page gives."""
        canvas: Canvas = self.canv
        tallest = max(d.height for d in self.drawings) * self.scale
        x = 0.0
        for drawing in self.drawings:
            canvas.saveState()
            canvas.translate(x, tallest)
            canvas.scale(self.scale, self.scale)
            for shape in drawing.shapes:
                _shape(canvas, shape)
            canvas.restoreState()
            x += drawing.width * self.scale + GAP


def pdf(document: blocks.Document) -> bytes:
    """Return the whole file."""
    load_fonts()
    file = io.BytesIO()
    template = BaseDocTemplate(
        file, pagesize=A4, title=printable(document.title), author="Gapbridge",
        subject=printable(document.subtitle),
        leftMargin=SIDE, rightMargin=SIDE, topMargin=TOP, bottomMargin=BOTTOM,
    )  # fmt: skip
    frame = Frame(SIDE, BOTTOM, WIDTH, A4[1] - TOP - BOTTOM, 0, 0, 0, 0)
    template.addPageTemplates([PageTemplate("page", [frame], onPage=_footer(document.footer))])
    story: list[Flowable] = [
        Paragraph(markup(document.title), STYLES["title"]),
        Paragraph(markup(document.subtitle), STYLES["subtitle"]),
    ]
    for part in document.parts:
        story += _part(part)
    template.build(story, canvasmaker=_Numbered)
    return file.getvalue()


def _footer(text: str) -> Callable[[Canvas, BaseDocTemplate], None]:
    def draw(canvas: Canvas, template: BaseDocTemplate) -> None:
        canvas.saveState()
        line = Paragraph(markup(text), STYLES["tile_label"])
        line.wrap(WIDTH - 60, 20)
        line.drawOn(canvas, SIDE, 9.3 * mm)
        canvas.restoreState()

    return draw


class _Numbered(Canvas):
    """A canvas that prints "page 1 of N": the pages are kept until N is known."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._pages: list[dict[str, Any]] = []

    def showPage(self) -> None:
        """Keep the page until all are drawn."""
        self._pages.append(dict(self.__dict__))
        self._startPage()  # type: ignore[attr-defined]

    def save(self) -> None:
        """Draw the number of every page, and write the file."""
        for number, page in enumerate(self._pages, start=1):
            self.__dict__.update(page)
            self.setFont(PLAIN, 7.5)
            self.setFillColor(HexColor("#5b6770"))
            text = f"page {number} of {len(self._pages)}"
            self.drawRightString(A4[0] - SIDE, 10 * mm, text)
            super().showPage()
        super().save()


def _part(part: blocks.Part) -> list[Flowable]:
    """Return a section; its heading is never alone at the foot of a page."""
    head: list[Flowable] = [Paragraph(markup(part.title), STYLES["h2"])]
    if part.about:
        head.append(Paragraph(markup(part.about), STYLES["note"]))
    kept: list[list[Flowable]] = [head]
    for block in part.blocks:
        groups = _block(block)
        if isinstance(block, blocks.Table) and len(block.rows) > MAX_UNSPLIT_ROWS:
            # a long table may be split; its heading needs space for some rows
            loose = kept.pop() if kept[-1] is head or _is_heading(kept[-1][-1]) else []
            kept += [[CondPageBreak(MIN_SPACE)], *[[f] for f in loose], *groups]
            continue
        if kept[-1] is head or (_is_heading(kept[-1][-1])):
            kept[-1] = [*kept[-1], *groups.pop(0)]
        kept += groups
    return [KeepTogether(group) if len(group) > 1 else group[0] for group in kept]


def _is_heading(flowable: Flowable) -> bool:
    return isinstance(flowable, Paragraph) and flowable.style is STYLES["h3"]


def _block(block: blocks.Block) -> list[list[Flowable]]:
    """Return the flowables of a block, in groups that are not split between pages."""
    if isinstance(block, blocks.Paragraph):
        return [[Paragraph(markup(block.text), STYLES[block.kind or "text"])]]
    if isinstance(block, blocks.Heading):
        return [[Paragraph(markup(block.text), STYLES["h3"])]]
    if isinstance(block, blocks.Bullets):
        return [[Paragraph(markup(i), STYLES["bullet"], bulletText="•")] for i in block.items]
    if isinstance(block, blocks.Verdict):
        badges = " ".join(badge_markup(badge) for badge in (block.badge, *block.more))
        word = Paragraph(badges, STYLES["verdict"])
        return [[word, Paragraph(markup(block.text), STYLES["lead"])]]
    if isinstance(block, blocks.Tiles):
        return [[tiles_table(block, WIDTH), Spacer(1, 8)]]
    if isinstance(block, blocks.Columns):
        return [[columns_table(block, WIDTH), Spacer(1, 6)]]
    if isinstance(block, blocks.TableRow):
        return [[table_row(block, WIDTH), Spacer(1, 8)]]
    if isinstance(block, blocks.Gallery):
        return _pictures(blocks.Pictures(block.drawings[:1], block.caption))
    if isinstance(block, blocks.View):
        return _pictures(blocks.Pictures((block.scene.drawing(),), block.caption))
    if isinstance(block, blocks.Table):
        long = len(block.rows) > MAX_UNSPLIT_ROWS
        grid, space = table(block, WIDTH), Spacer(1, 8)
        return [[grid], [space]] if long else [[grid, space]]
    return _pictures(block)


def _pictures(block: blocks.Pictures) -> list[list[Flowable]]:
    """Return the drawings, two in a row; the caption stays with the last row."""
    rows: list[list[Flowable]] = [
        [DrawnRow(block.drawings[i : i + 2])] for i in range(0, len(block.drawings), 2)
    ]
    if block.caption:
        rows[-1].append(Paragraph(markup(block.caption), STYLES["note"]))
    return rows


def _shape(canvas: Canvas, shape: drawn.Shape) -> None:
    """Draw one shape; y of a PDF page points up."""
    if isinstance(shape, drawn.Line):
        _stroke(canvas, shape.stroke)
        path = canvas.beginPath()
        path.moveTo(shape.points[0][0], -shape.points[0][1])
        for x, y in shape.points[1:]:
            path.lineTo(x, -y)
        canvas.drawPath(path)
    elif isinstance(shape, drawn.Rectangle):
        canvas.setFillColor(HexColor(drawn.PALETTE[shape.fill]))
        canvas.rect(shape.x, -shape.y - shape.height, shape.width, shape.height, 0, 1)
    elif isinstance(shape, drawn.Dots):
        _stroke(canvas, drawn.Stroke(shape.fill, 2 * shape.radius))
        canvas.setLineCap(1)
        canvas.setStrokeAlpha(shape.opacity)
        canvas.lines([(x, -y, x, -y) for x, y in shape.points])
        canvas.setStrokeAlpha(1.0)
        canvas.setLineCap(0)
    elif isinstance(shape, drawn.Circle):
        canvas.setFillColor(HexColor(drawn.PALETTE[shape.fill]))
        canvas.setFillAlpha(shape.opacity)
        canvas.circle(shape.x, -shape.y, shape.radius, 0, 1)
        canvas.setFillAlpha(1.0)
    else:
        _text(canvas, shape)


def _text(canvas: Canvas, shape: drawn.Text) -> None:
    canvas.saveState()
    canvas.setFillColor(HexColor(drawn.PALETTE[shape.colour]))
    canvas.setFont(BOLD if shape.bold else PLAIN, shape.size)
    canvas.translate(shape.x, -shape.y)
    if shape.turned:
        canvas.rotate(90)
    draw = {"start": canvas.drawString, "middle": canvas.drawCentredString,
            "end": canvas.drawRightString}[shape.anchor]  # fmt: skip
    draw(0, 0, shape.text)
    canvas.restoreState()


def _stroke(canvas: Canvas, stroke: drawn.Stroke) -> None:
    canvas.setStrokeColor(HexColor(drawn.PALETTE[stroke.colour]))
    canvas.setLineWidth(stroke.width)
    canvas.setLineJoin(1)
    canvas.setDash([4, 3] if stroke.dashed else [])


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


@cache
def load_fonts() -> None:
    """Register the PDF's fonts with reportlab."""
    folder = files("gapbridge.bridge.document").joinpath("fonts")
    for name, file in ((PLAIN, "DejaVuSansCondensed.ttf"), (BOLD, "DejaVuSansCondensed-Bold.ttf")):
        with as_file(folder.joinpath(file)) as path:
            pdfmetrics.registerFont(TTFont(name, str(path)))
    pdfmetrics.registerFontFamily(PLAIN, PLAIN, BOLD, PLAIN, BOLD)
    for name in (HAN, KANA, HANGUL):
        pdfmetrics.registerFont(UnicodeCIDFont(name))


def markup(text: str) -> str:
    """Return a text as reportlab's markup, with fonts for Chinese, Japanese and Korean."""
    text = printable(text)
    if text.isascii():
        return escape(text)
    japanese = re.search(r"[\u3040-\u30ff]", text) is not None
    return "".join(_run(run, japanese) for run in _RUNS.findall(text))


def _run(run: str, japanese: bool) -> str:
    if re.match(f"[{_HANGUL}]", run):
        font = HANGUL
    elif re.match(f"[{_HAN}]", run):
        font = KANA if japanese else HAN
    else:
        return escape(run)
    return f'<font name="{font}">{escape(run)}</font>'


def _style(name: str, **changes: Any) -> ParagraphStyle:
    return ParagraphStyle(name, parent=_TEXT, **changes)


STYLES = {
    "text": _TEXT,
    "title": _style("title", fontName=BOLD, fontSize=17, leading=21, spaceAfter=2),
    "subtitle": _style("subtitle", textColor=SOFT, spaceAfter=8),
    "h2": _style("h2", fontName=BOLD, fontSize=12.5, leading=16, spaceBefore=12, spaceAfter=3),
    "h3": _style("h3", fontName=BOLD, fontSize=9.5, leading=12.5, spaceBefore=7, spaceAfter=3),
    "lead": _style("lead", fontSize=10, leading=14, spaceAfter=6),
    "note": _style("note", fontSize=8, leading=10.5, textColor=SOFT, spaceAfter=6),
    "verdict": _style("verdict", fontName=BOLD, fontSize=10, leading=15, spaceBefore=3),
    "bullet": _style("bullet", leftIndent=10, bulletIndent=1, spaceAfter=3),
    "cell": _style("cell", fontSize=8, leading=10, spaceAfter=0),
    "number": _style("number", fontSize=8, leading=10, spaceAfter=0, alignment=2),
    "name": _style("name", fontSize=8, leading=10, spaceAfter=0, textColor=SOFT),
    "head": _style("head", fontName=BOLD, fontSize=7.5, leading=9.5, spaceAfter=0, textColor=SOFT),
    "head_number": _style("head_number", fontName=BOLD, fontSize=7.5, leading=9.5, spaceAfter=0,
                          textColor=SOFT, alignment=2),
    "tile_label": _style("tile_label", fontSize=7.5, leading=9.5, spaceAfter=1, textColor=SOFT),
    "tile_value": _style("tile_value", fontName=BOLD, fontSize=12, leading=15, spaceAfter=1),
}  # fmt: skip


def badge_markup(badge: Badge) -> str:
    """Return a badge as text on a coloured background."""
    ground, ink = BADGE_COLOURS[badge.kind]
    return (
        f'<font name="{BOLD}" color="{ink}" backColor="{ground}">'
        f"&nbsp;{markup(badge.text)}&nbsp;</font>"
    )
