"""What an instrument is: opened once, read at each pose, closed; SI inside, units declared."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from types import TracebackType
from typing import Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from bridge.calibration.instruments.settings import Base

Array = NDArray[np.float64]
S = TypeVar("S", bound=Base)


class Ask(Protocol):
    """Asks the person at the terminal for one line; commands of the session are raised."""

    def __call__(self, question: str) -> str:
        """Return what was typed, stripped."""
        ...


@dataclass(frozen=True)
class Surroundings:
    """What an instrument may use of the session."""

    ask: Ask
    link_host: str = ""  # of the cell's controller; empty: none
    taken: int = 0  # readings that earlier parts of the session have had from it


@dataclass(frozen=True)
class Where:
    """What is to be measured now."""

    number: int  # of the reading, from 0: how many the instrument has given before
    samples: int  # how many to average, where it gives more than one
    ask_again: Callable[[], None] = field(default=lambda: None)


class ReadingError(Exception):
    """What came from the instrument is no reading; the message says why. It is asked again."""


class Instrument(ABC, Generic[S]):
    """One instrument, for one thread. The constructor opens nothing."""

    manual = False  # a person reads it: mistakes of typing happen

    def __init__(self, settings: S, around: Surroundings) -> None:
        self.settings, self.around = settings, around

    @property
    def kind(self) -> str:
        """Return the kind of its readings, a key of the calibration's observables."""
        return self.settings.measures

    @property
    @abstractmethod
    def name(self) -> str:
        """Return how people call it, with its unit."""

    def open(self) -> None:  # noqa: B027
        """Get ready. Raises InputError or LinkError where it cannot be reached."""

    @abstractmethod
    def read(self, where: Where) -> Array:
        """Return samples (M, k) in SI, M at least 1, of the target where it is now.

        Raises ReadingError where what came is no reading, LinkError where it is gone.
        """

    def close(self) -> None:  # noqa: B027
        """Let go of it. Never raises; may be repeated."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
