"""Findings of a diagnosis as enums and numbers; ``bridge`` makes the text."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

from gapbridge.core.effects import Term
from gapbridge.core.log.log_finding import LogFinding


class Check(Enum):
    """A check that a selected term failed."""

    CURVED = auto()  # its stiffness curve cannot be distinguished from a straight line
    INSIDE_BOUNDS = auto()
    SIGNIFICANT = auto()  # its value is enough standard deviations from zero
    USUAL_SIZE = auto()  # its value is not far below the usual size
    NOT_LOCALISED = auto()  # a line is not replaced by one bump in the joint's angle
    STABLE_VALUE = auto()  # its value is stable when the residual structure is modelled
    CONSTANT = auto()  # its value does not depend on a quantity of the log
    COMPANION = auto()  # the effect that it requires is accused or declared
    SEPARATED = auto()  # the flange turns, so that a sensor's constant is not a load
    NOT_A_LEVEL = auto()  # it does not step exactly when a quantity of the log changes level
    HELD_OUT_GAIN = auto()  # it reduces the gap on held-out samples
    ALL_ROWS_GAIN = auto()  # the same over all rows of the log


@dataclass(frozen=True)
class Withdrawal:
    """Why a selected term is not accused."""

    failed: Check
    quantity: str = ""  # CONSTANT: the value depends on it; SEPARATED, NOT_A_LEVEL: confounded


class ParameterState(Enum):
    """Why the value of an accused parameter is no estimate."""

    ON_BOUND = auto()
    NOT_IDENTIFIABLE = auto()  # from these data: others have the same effect
    NOMINAL = auto()  # kept nominal: far larger than its like, and not significant by itself


@dataclass(frozen=True)
class ParameterNote:
    """A parameter of a cause whose value is no estimate; ``value`` in ``unit``."""

    state: ParameterState
    name: str
    value: float
    unit: str


@dataclass(frozen=True)
class TooFewRows:
    """A channel that has rows, but not enough for a diagnosis."""

    rows: int


@dataclass(frozen=True)
class Thinned:
    """A channel whose causes were searched on some of its rows and validated on all."""

    searched: int
    rows: int


@dataclass(frozen=True)
class Outliers:
    """Rows excluded as outliers: line in the file, and session name if there are several."""

    lines: tuple[tuple[int, str], ...]


@dataclass(frozen=True)
class NotAccused:
    """A term that was selected and withdrawn; ``stand_in``: it reduces the gap in new regions."""

    term: Term
    reason: Withdrawal
    stand_in: bool


@dataclass(frozen=True)
class Slip:
    """A term that steps once, between the last row before and the first row after."""

    term: Term
    before: float  # s, or the row where the log has no time
    after: float
    first: float  # of the log, as ``before``
    last: float
    timed: bool
    alone: bool  # no structure remains and nothing differs between sessions: the model holds
    session: str = ""  # the first session that has it, where the sessions' clocks overlap
    others: int = 0  # slips besides it
    between_sessions: bool = False


Fact = TooFewRows | Thinned | Outliers | NotAccused | Slip | ParameterNote


@dataclass(frozen=True)
class ChannelFinding:
    """One fact about one channel."""

    channel: str
    fact: Fact


Finding = ChannelFinding | LogFinding
