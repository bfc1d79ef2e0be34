"""Write a document as a PDF: A4, embedded font, numbered pages."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any

from reportlab.lib.colors import HexColor
from reportlab.lib.pagesizes import A4
from reportlab.lib.units import mm
from reportlab.pdfgen.canvas import Canvas
from reportlab.platypus import (
    BaseDocTemplate,
    CondPageBreak,
    Flowable,
    Frame,
    KeepTogether,
    PageTemplate,
    Spacer,
)
from reportlab.platypus import Paragraph as Text

from gapbridge.bridge.document import blocks
from gapbridge.bridge.document import drawing as drawn
from gapbridge.bridge.document.output_file import printable
from gapbridge.bridge.document.pdf_table import columns_table, table, table_row, tiles_table
from gapbridge.bridge.document.pdf_text import BOLD, PLAIN, STYLES, badge_markup, load_fonts, markup

SIDE, TOP, BOTTOM = 18 * mm, 16 * mm, 18 * mm
WIDTH = A4[0] - 2 * SIDE
MIN_SPACE = 120  # pt, for a heading and the first rows of a long table
GAP, LARGEST_SCALE = 16.0, 0.76  # between drawings in a row, pt; and of them
MAX_UNSPLIT_ROWS = 14  # of a table that is kept on one page


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
        Text(markup(document.title), STYLES["title"]),
        Text(markup(document.subtitle), STYLES["subtitle"]),
    ]
    for part in document.parts:
        story += _part(part)
    template.build(story, canvasmaker=_Numbered)
    return file.getvalue()


def _footer(text: str) -> Callable[[Canvas, BaseDocTemplate], None]:
    def draw(canvas: Canvas, template: BaseDocTemplate) -> None:
        canvas.saveState()
        line = Text(markup(text), STYLES["tile_label"])
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
    head: list[Flowable] = [Text(markup(part.title), STYLES["h2"])]
    if part.about:
        head.append(Text(markup(part.about), STYLES["note"]))
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
    return isinstance(flowable, Text) and flowable.style is STYLES["h3"]


def _block(block: blocks.Block) -> list[list[Flowable]]:
    """Return the flowables of a block, in groups that are not split between pages."""
    if isinstance(block, blocks.Paragraph):
        return [[Text(markup(block.text), STYLES[block.kind or "text"])]]
    if isinstance(block, blocks.Heading):
        return [[Text(markup(block.text), STYLES["h3"])]]
    if isinstance(block, blocks.Bullets):
        return [[Text(markup(i), STYLES["bullet"], bulletText="•")] for i in block.items]
    if isinstance(block, blocks.Verdict):
        badges = " ".join(badge_markup(badge) for badge in (block.badge, *block.more))
        word = Text(badges, STYLES["verdict"])
        return [[word, Text(markup(block.text), STYLES["lead"])]]
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
        rows[-1].append(Text(markup(block.caption), STYLES["note"]))
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
