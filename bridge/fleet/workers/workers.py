"""Workers: who does the tasks. One base, one file a member."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from typing import Self

from gapbridge.bridge.fleet.task import Outcome, Task


class Workers(ABC):
    """Processes that do tasks, here or elsewhere. Used in a ``with`` block."""

    def __enter__(self) -> Self:
        """Start them."""
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop them."""
        self.stop()

    @abstractmethod
    def start(self) -> None:
        """Start or reach them; raises GapbridgeError where that fails."""

    @abstractmethod
    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Give the outcomes as they come; every task has exactly one."""

    @abstractmethod
    def stop(self) -> None:
        """Stop what was started here, at once."""

    @abstractmethod
    def description(self) -> str:
        """Return who they are, for people."""
