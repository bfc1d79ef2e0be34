"""Text styles and fonts of the PDF; Chinese, Japanese and Korean use the reader's fonts."""

from __future__ import annotations

import re
from functools import cache
from html import escape
from importlib.resources import as_file, files
from typing import Any

from reportlab.lib.colors import HexColor
from reportlab.lib.styles import ParagraphStyle
from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.cidfonts import UnicodeCIDFont
from reportlab.pdfbase.ttfonts import TTFont

from gapbridge.bridge.document.blocks import Badge
from gapbridge.bridge.document.output_file import printable

PLAIN, BOLD = "Gapbridge", "Gapbridge-Bold"
HAN, KANA, HANGUL = "STSong-Light", "HeiseiKakuGo-W5", "HYGothic-Medium"
_HANGUL, _HAN = r"\u1100-\u11ff\uac00-\ud7af", r"\u2e80-\u9fff\uf900-\ufaff\uff00-\uffef"
_RUNS = re.compile(f"[{_HANGUL}]+|[{_HAN}]+|[^{_HANGUL}{_HAN}]+")
INK, SOFT = HexColor("#1c2730"), HexColor("#5b6770")
BADGE_COLOURS = {"good": ("#e2f4e9", "#1d6b42"), "doubtful": ("#fdf0d9", "#8a5a0b"),
           "bad": ("#fbe3e3", "#982a2a"), "quiet": ("#eef1f4", "#4d5962")}  # fmt: skip

_TEXT = ParagraphStyle("text", fontName=PLAIN, fontSize=9, leading=12.5, textColor=INK,
                       spaceAfter=5)  # fmt: skip


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
