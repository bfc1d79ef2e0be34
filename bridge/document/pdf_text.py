"""Text of the PDF: what its own font has no letters for is set in a font of the reader's."""

from __future__ import annotations

import re
from functools import cache
from html import escape
from importlib.resources import as_file, files

from reportlab.pdfbase import pdfmetrics
from reportlab.pdfbase.cidfonts import UnicodeCIDFont
from reportlab.pdfbase.ttfonts import TTFont

PLAIN, BOLD = "Gapbridge", "Gapbridge-Bold"
HAN, KANA, HANGUL = "STSong-Light", "HeiseiKakuGo-W5", "HYGothic-Medium"
_HANGUL, _HAN = r"\u1100-\u11ff\uac00-\ud7af", r"\u2e80-\u9fff\uf900-\ufaff\uff00-\uffef"
_RUNS = re.compile(f"[{_HANGUL}]+|[{_HAN}]+|[^{_HANGUL}{_HAN}]+")


@cache
def load_fonts() -> None:
    """Make the PDF's fonts known to the library."""
    folder = files("gapbridge.bridge.document").joinpath("fonts")
    for name, file in ((PLAIN, "DejaVuSansCondensed.ttf"), (BOLD, "DejaVuSansCondensed-Bold.ttf")):
        with as_file(folder.joinpath(file)) as path:
            pdfmetrics.registerFont(TTFont(name, str(path)))
    pdfmetrics.registerFontFamily(PLAIN, PLAIN, BOLD, PLAIN, BOLD)
    for name in (HAN, KANA, HANGUL):
        pdfmetrics.registerFont(UnicodeCIDFont(name))


def markup(text: str) -> str:
    """Return a text as the library's markup; runs of Chinese, Japanese, Korean have their font."""
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
