"""Blocks of a report, described once and written twice: as HTML and as PDF."""

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
    """A short word on a coloured ground; ``kind`` is GOOD, DOUBTFUL, BAD or QUIET."""

    text: str
    kind: str


@dataclass(frozen=True)
class Bar:
    """A small bar for a share of 0 to 1, with its figure beside it."""

    share: float | None
    text: str
    colour: str = AFTER

    @property
    def filled(self) -> float:
        """Return the share that can be drawn, 0 to 1."""
        given = self.share
        return 0.0 if given is None or not math.isfinite(given) else min(max(given, 0.0), 1.0)


@dataclass(frozen=True)
class Named:
    """A name in bold, what belongs to it, and its identifier below."""

    text: str
    more: str = ""
    code: str = ""


Cell = str | Strong | Badge | Bar | Named


@dataclass(frozen=True)
class Verdict:
    """The answer in one word and one sentence."""

    badge: Badge
    text: str
    more: tuple[Badge, ...] = ()  # beside the first


@dataclass(frozen=True)
class Tile:
    """One large figure."""

    label: str
    value: str
    note: str = ""


@dataclass(frozen=True)
class Tiles:
    """Large figures side by side."""

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
    """Names and what belongs to them, as on the front of a certificate."""

    pairs: tuple[tuple[str, str], ...]
    title: str = ""


@dataclass(frozen=True)
class Columns:
    """Pairs side by side where there is room."""

    columns: tuple[Pairs, ...]


@dataclass(frozen=True)
class Table:
    """A table; ``widths`` are relative, ``numbers`` are the columns that stand to the right."""

    heads: tuple[str, ...]
    rows: Sequence[Sequence[Cell]]
    widths: tuple[float, ...] = ()
    numbers: tuple[int, ...] = ()
    sums: int = 0  # rows at the end that are set off from the others


@dataclass(frozen=True)
class Pictures:
    """Drawings side by side where there is room, with one caption."""

    drawings: tuple[Drawing, ...]
    caption: str = ""


@dataclass(frozen=True)
class Beside:
    """Small tables side by side where there is room."""

    tables: tuple[Table, ...]


@dataclass(frozen=True)
class Gallery:
    """One drawing of several, which the page's menus choose from; paper shows the first.

    ``menus`` are titles with their entries; the drawings stand in the order of the menus' entries,
    those of the last menu next to each other.
    """

    menus: tuple[tuple[str, tuple[str, ...]], ...]
    drawings: tuple[Drawing, ...]
    caption: str = ""


@dataclass(frozen=True)
class View:
    """Lines in space, which the page lets one turn; paper shows them from one side."""

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
    | Beside
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
    folded: bool = False  # True: the page shows it only when asked to


@dataclass(frozen=True)
class Document:
    """A whole report."""

    title: str
    subtitle: str
    parts: tuple[Part, ...]
    footer: str = field(default="")  # stands on every page of the PDF


@dataclass(frozen=True)
class Section(Generic[M]):
    """One section; ``blocks`` makes its blocks of M: none where there is nothing to show."""

    key: str
    title: str
    blocks: Callable[[M], list[Block]]
    about: str = ""
    folded: bool = False  # True: the page shows it only when asked to


def parts(sections: Sequence[Section[M]], material: M) -> tuple[Part, ...]:
    """Return the sections that have something to show as parts of a document."""
    made = [(s, s.blocks(material)) for s in sections]
    return tuple(Part(s.key, s.title, s.about, b, s.folded) for s, b in made if b)
