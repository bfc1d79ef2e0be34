"""One row of the table of faults: how it is made, and what must come of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.faults.links import LINKS, Link
from benchmarks.faults.rig import Rig

Inject = Callable[[Rig], None]
Limit = Callable[[Link], float]
"""Longest time to the detection on a link, s."""


@dataclass(frozen=True)
class Result:
    """What became of one fault. ``detected`` s after it was made, None: not at all."""

    row: str
    link: str
    cycle: float
    detected: float | None
    end: str
    largest_step: float  # m, on the wire
    step_allowed: float  # m, in one cycle
    wrong: tuple[str, ...] = ()  # what is not as it must be
    violated: bool = False  # an invariant did not hold on the wire
    late: float = 0.0  # s that the machine itself was late, 0: not more than the fault bears

    @property
    def cycles(self) -> float | None:
        """Return the time of the detection in cycles of the link."""
        return None if self.detected is None else self.detected / self.cycle

    @property
    def judged(self) -> bool:
        """Return whether it says something: not where it went wrong on a machine that was late.

        A violated invariant always does.
        """
        return self.violated or not self.wrong or self.late == 0.0


Own = Callable[[Link, Path], Rig]
Apart = Callable[["Row", Link, Path], Result]


@dataclass(frozen=True)
class Row:
    """A fault.

    fault: as facts and documents name it. how: how it is made. links: where it can happen.
    sign: how it is detected: ``left`` (compensating ends), names of counters of the loop, or
    ``event:KIND`` (KIND may be followed by a key that the event must have).
    within: longest time to that, s, by link. end: states it may end in, once it is over, without a
    person; ``lasting``: s from the detection to the healing. ``inject`` makes it on a running rig;
    ``own`` makes the rig of a fault that needs settings of its own; ``apart`` runs one that ends
    the daemon itself, or keeps it from starting.
    """

    key: str
    fault: str
    how: str
    inject: Inject | None = None
    links: tuple[str, ...] = tuple(LINKS)
    sign: str = "left"
    within: Limit = lambda link: link.hold + 0.1
    end: tuple[str, ...] = ("observing",)
    lasting: float = 0.0
    own: Own | None = None
    apart: Apart | None = None
    slow: bool = False
    after: Inject | None = field(default=None)  # undoes what healing the rig does not

    @property
    def shares(self) -> bool:
        """Return whether it is made on a rig that runs already."""
        return self.own is None and self.apart is None


def cycles(count: float, least: float = 0.06) -> Limit:
    """Return a limit of so many cycles; ``least`` (s) is what a busy machine may take."""
    return lambda link: max(count * link.cycle, least)


def seconds(limit: float) -> Limit:
    """Return a limit that is the same on all links."""
    return lambda link: limit
