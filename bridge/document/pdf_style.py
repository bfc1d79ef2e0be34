"""How the PDF's texts look."""

from __future__ import annotations

from typing import Any

from reportlab.lib.colors import HexColor
from reportlab.lib.styles import ParagraphStyle

from gapbridge.bridge.document.blocks import Badge
from gapbridge.bridge.document.pdf_text import BOLD, PLAIN, markup

INK, SOFT = HexColor("#1c2730"), HexColor("#5b6770")
GROUNDS = {"good": ("#e2f4e9", "#1d6b42"), "doubtful": ("#fdf0d9", "#8a5a0b"),
           "bad": ("#fbe3e3", "#982a2a"), "quiet": ("#eef1f4", "#4d5962")}  # fmt: skip

_TEXT = ParagraphStyle("text", fontName=PLAIN, fontSize=9, leading=12.5, textColor=INK,
                       spaceAfter=5)  # fmt: skip


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
    """Return a badge as text on a coloured ground."""
    ground, ink = GROUNDS[badge.kind]
    return (
        f'<font name="{BOLD}" color="{ink}" backColor="{ground}">'
        f"&nbsp;{markup(badge.text)}&nbsp;</font>"
    )
