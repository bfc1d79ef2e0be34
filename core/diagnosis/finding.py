"""What a diagnosis reports beside its figures: enums and numbers; ``bridge`` words them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto

from gapbridge.core.effects import Term
from gapbridge.core.log.log_finding import LogFinding


class Check(Enum):
    """A check that a selected term failed."""

    CURVED = auto()  # its stiffness curve cannot be distinguished from a straight line
    INSIDE_BOUNDS = auto()
    SIGNIFICANT = auto()  # its value is enough of its own sigmas
    USUAL_SIZE = auto()  # its value is not far below what arms have
    NOT_LOCALISED = auto()  # one bump in the joint's angle does not do as well
    STABLE_VALUE = auto()  # it keeps its value beside unnamed functions for what is left
    CONSTANT = auto()  # its value does not go by a quantity of the log
    COMPANION = auto()  # what shows it is declared, or accused beside it
    SEPARATED = auto()  # the log does not show that it is no load: the flange turns
    NOT_A_LEVEL = auto()  # it does not step where a quantity of the log leaves all its levels
    HELD_OUT_GAIN = auto()  # it shrinks the gap on samples that its fit did not see
    ALL_ROWS_GAIN = auto()  # the same over all rows of the log


@dataclass(frozen=True)
class Withdrawal:
    """Why a selected term is not accused."""

    failed: Check
    quantity: str = ""  # CONSTANT: what the value goes by; SEPARATED, NOT_A_LEVEL: instead of what


class ParameterState(Enum):
    """What keeps the value of an accused parameter from being an estimate."""

    ON_BOUND = auto()
    NOT_IDENTIFIABLE = auto()  # from these data: others can stand in for it
    HELD = auto()  # nominal: far from the size of its like, and not sure by itself


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
    """A channel whose causes were searched on some of its rows and judged on all."""

    searched: int
    rows: int


@dataclass(frozen=True)
class Outliers:
    """Rows excluded as outliers: each one's line in its file, and its session where several are."""

    lines: tuple[tuple[int, str], ...]


@dataclass(frozen=True)
class NotAccused:
    """A term that was selected and withdrawn; ``stand_in``: poses not fitted gain by it."""

    term: Term
    reason: Withdrawal
    stand_in: bool


@dataclass(frozen=True)
class Slip:
    """A term that steps once, between the last row before and the first row after."""

    term: Term
    before: float  # s, or the row where the log has no time
    after: float
    timed: bool
    alone: bool  # nothing else remains: the model holds on both sides


Fact = TooFewRows | Thinned | Outliers | NotAccused | Slip | ParameterNote


@dataclass(frozen=True)
class ChannelFinding:
    """One fact about one channel."""

    channel: str
    fact: Fact


Finding = ChannelFinding | LogFinding
