"""The base of the report's sections."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar, Generic, TypeVar

from gapbridge.bridge.document.blocks import Block, Part

M = TypeVar("M")


class Section(ABC, Generic[M]):
    """One section: what it is called, what it is for, and the blocks that it makes of M."""

    key: ClassVar[str]
    title: ClassVar[str]
    about: ClassVar[str] = ""
    folded: ClassVar[bool] = False  # True: the page shows it only when asked to

    @abstractmethod
    def blocks(self, material: M) -> list[Block]:
        """Return the section's blocks; none where there is nothing to show."""

    def part(self, material: M) -> Part | None:
        """Return the section as a part of a document; None where there is nothing to show."""
        blocks = tuple(self.blocks(material))
        return Part(self.key, self.title, self.about, blocks, self.folded) if blocks else None
