"""What an instrument is: opened once, read at each pose, closed; SI inside, units declared."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Generic, Protocol, Self, TypeVar

from gapbridge.bridge.cell.settings.instruments import Base
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import Payload

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
    since: float = 0.0  # s, time.time() when the session began: what is older is none of its


@dataclass(frozen=True)
class Where:
    """What is to be measured now."""

    stop: int = 1  # number of the stop in the plan, from 1
    samples: int = 1  # how many to average, where it gives more than one
    used: frozenset[str] = frozenset()  # sources of readings that have been had before


@dataclass(frozen=True)
class Samples:
    """What one look through the instrument gave."""

    values: Array  # (M, k) SI, M at least 1
    source: str = ""  # row or file that it stood in, so that none counts twice


class ReadingError(Exception):
    """What came from the instrument is no reading; the message says why. It is asked again."""


class Instrument(ABC, Generic[S]):
    """One instrument, for one thread. The constructor opens nothing."""

    manual = False  # a person reads it: mistakes of typing happen
    waits = False  # for the person, or for what is exported: nobody need say when to read
    needs_wrench = False  # the controller must report the raw reading of a flange sensor
    stands = "the instrument"  # what has a place in the cell, in words
    seats = False  # the tool is brought onto something by hand: the joints are read afterwards

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

    def open(self) -> None:
        """Get ready. Raises InputError or LinkError where it cannot be reached."""

    @abstractmethod
    def read(self, where: Where) -> Samples:
        """Return samples of the target where it is now.

        Raises ReadingError where what came is no reading, LinkError where it is gone.
        """

    def hung(self, load: Payload) -> None:
        """Take the load on the flange, which a simulated one hangs there.

        Raises LinkError.
        """

    def close(self) -> None:
        """Let go of it. Never raises; may be repeated."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


AnyInstrument = Instrument[Any]
