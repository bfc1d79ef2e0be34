"""A document as a PDF: A4, its own font, numbered pages."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import cache
from html import escape
from importlib.resources import as_file, files

from reportlab.lib.colors import HexColor
from reportlab.lib.pagesizes import A4
from reportlab.lib.units import mm
from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.ttfonts import TTFont
from reportlab.pdfgen.canvas import Canvas
from reportlab.platypus import (
    BaseDocTemplate,
    Flowable,
    Frame,
    KeepTogether,
    PageTemplate,
    Spacer,
)
from reportlab.platypus import Paragraph as Text

from bridge.calibration.report.blocks import (
    Block,
    Bullets,
    Document,
    Heading,
    Pairs,
    Paragraph,
    Part,
    Pictures,
    Table,
    Tiles,
    Verdict,
)
from bridge.calibration.report.pdf_drawing import BOLD, PLAIN, DrawnRow
from bridge.calibration.report.pdf_style import STYLES, badge_markup
from bridge.calibration.report.pdf_table import pairs_table, table, tiles_table

SIDE, TOP, BOTTOM = 18 * mm, 16 * mm, 18 * mm
WIDTH = A4[0] - 2 * SIDE


def pdf(document: Document) -> bytes:
    """Return the whole file."""
    _load_fonts()
    file = io.BytesIO()
    template = BaseDocTemplate(
        file, pagesize=A4, title=document.title, author="Gapbridge", subject=document.subtitle,
        leftMargin=SIDE, rightMargin=SIDE, topMargin=TOP, bottomMargin=BOTTOM,
    )  # fmt: skip
    frame = Frame(SIDE, BOTTOM, WIDTH, A4[1] - TOP - BOTTOM, 0, 0, 0, 0)
    template.addPageTemplates([PageTemplate("page", [frame], onPage=_footer(document.footer))])
    story: list[Flowable] = [
        Text(escape(document.title), STYLES["title"]),
        Text(escape(document.subtitle), STYLES["subtitle"]),
    ]
    for part in document.parts:
        story += _part(part)
    template.build(story)
    return file.getvalue()


@cache
def _load_fonts() -> None:
    folder = files("bridge.calibration.report").joinpath("fonts")
    for name, file in ((PLAIN, "DejaVuSansCondensed.ttf"), (BOLD, "DejaVuSansCondensed-Bold.ttf")):
        with as_file(folder.joinpath(file)) as path:
            pdfmetrics.registerFont(TTFont(name, str(path)))
    pdfmetrics.registerFontFamily(PLAIN, PLAIN, BOLD, PLAIN, BOLD)


def _footer(text: str) -> Callable[[Canvas, BaseDocTemplate], None]:
    def draw(canvas: Canvas, template: BaseDocTemplate) -> None:
        canvas.saveState()
        canvas.setFont(PLAIN, 7.5)
        canvas.setFillColor(HexColor("#5b6770"))
        canvas.drawString(SIDE, 10 * mm, text)
        canvas.drawRightString(A4[0] - SIDE, 10 * mm, f"page {canvas.getPageNumber()}")
        canvas.restoreState()

    return draw


def _part(part: Part) -> list[Flowable]:
    """Return a section; its heading never stands alone at the foot of a page."""
    head: list[Flowable] = [Text(escape(part.title), STYLES["h2"])]
    if part.about:
        head.append(Text(escape(part.about), STYLES["note"]))
    blocks = [_block(block) for block in part.blocks]
    if not blocks:
        return head
    return [KeepTogether([*head, *blocks[0]]), *[f for block in blocks[1:] for f in block]]


def _block(block: Block) -> list[Flowable]:
    if isinstance(block, Paragraph):
        return [Text(escape(block.text), STYLES[block.kind or "text"])]
    if isinstance(block, Heading):
        return [Text(escape(block.text), STYLES["h3"])]
    if isinstance(block, Bullets):
        return [Text(escape(item), STYLES["bullet"], bulletText="•") for item in block.items]
    if isinstance(block, Verdict):
        return [
            Text(badge_markup(block.badge), STYLES["verdict"]),
            Text(escape(block.text), STYLES["lead"]),
        ]
    if isinstance(block, Tiles):
        return [tiles_table(block, WIDTH), Spacer(1, 8)]
    if isinstance(block, Pairs):
        return [pairs_table(block, WIDTH), Spacer(1, 6)]
    if isinstance(block, Table):
        return [table(block, WIDTH), Spacer(1, 8)]
    return _pictures(block)


def _pictures(block: Pictures) -> list[Flowable]:
    """Return the drawings, two in a row, together with their caption."""
    rows: list[Flowable] = [
        DrawnRow(block.drawings[i : i + 2]) for i in range(0, len(block.drawings), 2)
    ]
    if block.caption:
        rows.append(Text(escape(block.caption), STYLES["note"]))
    return [KeepTogether(rows)]
