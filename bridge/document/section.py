"""A section of a report: what it is called, what it is for, and who makes its blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from gapbridge.bridge.document.blocks import Block, Part

M = TypeVar("M")


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
    made = [(s, tuple(s.blocks(material))) for s in sections]
    return tuple(Part(s.key, s.title, s.about, b, s.folded) for s, b in made if b)
