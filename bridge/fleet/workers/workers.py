"""The interface of workers, which run the tasks."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from typing import Self

from gapbridge.bridge.fleet.task import Outcome, Task


class Workers(ABC):
    """Processes that run tasks, local or remote; used as a context manager."""

    def __enter__(self) -> Self:
        """Start them."""
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop them."""
        self.stop()

    @abstractmethod
    def start(self) -> None:
        """Start or connect to them; raises GapbridgeError on failure."""

    @abstractmethod
    def run(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """Yield the outcomes as they finish, exactly one per task."""

    @abstractmethod
    def stop(self) -> None:
        """Stop the processes that were started here, at once."""

    @abstractmethod
    def description(self) -> str:
        """Return a description for the user."""
