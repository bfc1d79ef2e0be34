"""Base of all instruments: opened once, read at each pose, closed; values are in SI units."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, Self, TypeVar

from gapbridge.bridge.cell.settings.instruments import Base
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import Payload

S = TypeVar("S", bound=Base)


Ask = Callable[[str], str]
"""Asks the operator a question and returns what was typed, stripped; a command of the session
raises SessionCommand."""


@dataclass(frozen=True)
class InstrumentContext:
    """What the session provides to an instrument."""

    ask: Ask
    link_host: str = ""  # address of the cell's controller; empty: none
    since: float = 0.0  # s, time.time() when the session began; older files are ignored


@dataclass(frozen=True)
class ReadRequest:
    """Which reading is requested."""

    stop: int = 1  # number of the stop in the plan, from 1
    samples: int = 1  # number to average, for an instrument that gives several
    used: frozenset[str] = frozenset()  # sources of readings that were used before


@dataclass(frozen=True)
class Samples:
    """The samples of one reading."""

    values: Array  # (M, k) SI, M at least 1
    source: str = ""  # row or file it was read from, so that none is used twice


class ReadingError(Exception):
    """The instrument gave no valid reading; the message says why. The reading is repeated."""


class ArmMovedError(ReadingError):
    """The arm has left where its joints were sampled, or may have: they are sampled again."""

    def __init__(self, message: str, source: str) -> None:
        super().__init__(message)
        self.source = source  # of the reading that is discarded, as Samples.source


class Instrument(ABC, Generic[S]):
    """One instrument; not thread-safe. The constructor opens nothing."""

    manual = False  # its readings are typed, so typing errors are possible
    self_triggered = False  # ``read`` waits for the operator or a file: no prompt before it
    needs_wrench = False  # the controller must report ft_raw_wrench
    placed_part = "the instrument"  # name of the part that is placed in the cell, for messages
    contact = False  # the tool is brought into contact by hand: joints are read after ``read``

    def __init__(self, settings: S, context: InstrumentContext) -> None:
        self.settings, self.context = settings, context

    @property
    def kind(self) -> str:
        """Return the kind of its readings, a key of core.calibration.observables.OBSERVABLES."""
        return self.settings.measures

    @property
    @abstractmethod
    def name(self) -> str:
        """Return its name for messages, with its unit."""

    def open(self) -> None:
        """Connect to it or check its files. Raises InputError, LinkError."""

    @abstractmethod
    def read(self, request: ReadRequest) -> Samples:
        """Return samples (M, k), SI units, of the target at its present position.

        Raises ReadingError if a reading is invalid, LinkError if the connection is lost.
        """

    def earlier(self, live: bool) -> tuple[str, ...]:
        """Return the sources of readings from before the session's first question.

        ``live``: the arm is read as well, so that none of those that are there can be of it.
        """
        return ()

    def set_load(self, load: Payload) -> None:
        """Note the load that was mounted; a simulated instrument mounts it in the simulation.

        Raises LinkError.
        """

    def close(self) -> None:
        """Disconnect. Never raises; may be repeated."""

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


AnyInstrument = Instrument[Any]
