"""Blocks of a report; html.py and pdf.py write them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

from gapbridge.bridge.document.drawing import AFTER, Drawing
from gapbridge.bridge.document.scene import Scene

GOOD, DOUBTFUL, BAD, QUIET = "good", "doubtful", "bad", "quiet"
M = TypeVar("M")


@dataclass(frozen=True)
class Strong:
    """Text in bold."""

    text: str


@dataclass(frozen=True)
class Badge:
    """A short word on a coloured background; ``kind`` is GOOD, DOUBTFUL, BAD or QUIET."""

    text: str
    kind: str


@dataclass(frozen=True)
class Bar:
    """A small bar for a share of 0 to 1, followed by its figure."""

    share: float | None
    text: str
    colour: str = AFTER

    @property
    def filled(self) -> float:
        """Return the share that can be drawn, 0 to 1."""
        share = self.share
        return 0.0 if share is None or not math.isfinite(share) else min(max(share, 0.0), 1.0)


@dataclass(frozen=True)
class Named:
    """A name in bold, further text, and an identifier below."""

    text: str
    more: str = ""
    code: str = ""


Cell = str | Strong | Badge | Bar | Named


@dataclass(frozen=True)
class Verdict:
    """A verdict: one word and one sentence."""

    badge: Badge
    text: str
    more: tuple[Badge, ...] = ()  # after the first


@dataclass(frozen=True)
class Tile:
    """One large figure."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Tiles:
    """Large figures in a row."""

    tiles: tuple[Tile, ...]


@dataclass(frozen=True)
class Heading:
    """A heading inside a section."""

    text: str


@dataclass(frozen=True)
class Paragraph:
    """A paragraph; ``kind`` is empty, "lead" (larger) or "note" (smaller)."""

    text: str
    kind: str = ""


@dataclass(frozen=True)
class Bullets:
    """A list."""

    items: tuple[str, ...]


@dataclass(frozen=True)
class Pairs:
    """Names and values, as on the front of a certificate."""

    pairs: tuple[tuple[str, str], ...]
    title: str = ""


@dataclass(frozen=True)
class Columns:
    """Pairs in columns where the page is wide enough."""

    columns: tuple[Pairs, ...]


@dataclass(frozen=True)
class Table:
    """A table; ``widths`` are relative, ``numbers`` are the columns that are right-aligned."""

    heads: tuple[str, ...]
    rows: Sequence[Sequence[Cell]]
    widths: tuple[float, ...] = ()
    numbers: tuple[int, ...] = ()
    sums: int = 0  # rows at the end that are sums, below a rule


@dataclass(frozen=True)
class Pictures:
    """Drawings in a row where the page is wide enough, with one caption."""

    drawings: tuple[Drawing, ...]
    caption: str = ""


@dataclass(frozen=True)
class TableRow:
    """Small tables in a row where the page is wide enough."""

    tables: tuple[Table, ...]


@dataclass(frozen=True)
class Gallery:
    """Several drawings, of which menus of the HTML page choose one; the PDF shows the first.

    ``menus`` are titles with their entries; the drawings are in the order of the menus' entries,
    the last menu varying fastest.
    """

    menus: tuple[tuple[str, tuple[str, ...]], ...]
    drawings: tuple[Drawing, ...]
    caption: str = ""


@dataclass(frozen=True)
class View:
    """A 3-D scene that can be turned on the HTML page; the PDF shows one view."""

    scene: Scene
    caption: str = ""


Block = (
    Verdict
    | Tiles
    | Heading
    | Paragraph
    | Bullets
    | Columns
    | Table
    | TableRow
    | Pictures
    | Gallery
    | View
)


@dataclass(frozen=True)
class Part:
    """One section of a document."""

    key: str
    title: str
    about: str
    blocks: Sequence[Block]
    folded: bool = False  # True: collapsed on the HTML page


@dataclass(frozen=True)
class Document:
    """A whole report."""

    title: str
    subtitle: str
    parts: tuple[Part, ...]
    footer: str = field(default="")  # on every page of the PDF


@dataclass(frozen=True)
class Section(Generic[M]):
    """One section; ``blocks`` returns its blocks for an M, or none to omit it."""

    key: str
    title: str
    blocks: Callable[[M], list[Block]]
    about: str = ""
    folded: bool = False  # True: collapsed on the HTML page


def parts(sections: Sequence[Section[M]], material: M) -> tuple[Part, ...]:
    """Return the parts of a document: the sections that are not empty."""
    content = [(s, s.blocks(material)) for s in sections]
    return tuple(Part(s.key, s.title, s.about, b, s.folded) for s, b in content if b)
