"""What a decoder makes of messages: fresh states on the way in, writes on the way out."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Literal, NamedTuple

Numbers = tuple[float, ...]
Kind = Literal["offset", "joints", "release", "other", "broken", "forbidden"]


class Fresh(NamedTuple):
    """A state that the client can know from ``time`` on (s, monotonic), ``earliest`` at best.

    ``stamp``: the controller's clock, s, NaN where the wire has none. ``safe``: whether it may
    move; ``safe_known``: whether the wire has said so at all. ``state`` is the supervisor's.
    """

    time: float
    stamp: float
    q: Numbers
    target_q: Numbers | None
    safe: bool
    safe_known: bool
    state: int
    earliest: float = math.nan
    bare: bool = False

    @property
    def early(self) -> float:
        """Return when the client may have known it at the earliest, s."""
        return self.time if math.isnan(self.earliest) else self.earliest


class Write(NamedTuple):
    """Something that the client wrote.

    offset: ``values`` (6,) m and rad, in base. joints: ``values`` (n,) rad. other: part of a
    write, watchdogs, enabling. broken: does not pass the receiver's own check. forbidden: nothing
    that a daemon may write. ``state`` is the supervisor's as the write was seen. It arrived between
    ``earliest`` and ``time`` (s, monotonic).
    """

    time: float
    kind: Kind
    values: Numbers
    where: str
    state: int
    earliest: float = math.nan

    @property
    def early(self) -> float:
        """Return when it may have arrived at the earliest, s."""
        return self.time if math.isnan(self.earliest) else self.earliest


Change = Callable[[list[float]], list[float]]


class Decoder(ABC):
    """Decodes one link, all its connections."""

    @abstractmethod
    def feed(
        self, time: float, connection: int, port: str, up: bool, message: bytes, state: int
    ) -> list[Fresh | Write]:
        """Return what a message reports; nothing for most."""

    @abstractmethod
    def patch(self, message: bytes, what: str, change: Change) -> bytes:
        """Return a message to the client with the numbers of ``what`` changed, if it has them.

        ``what``: ``q`` (rad), ``qd`` (rad/s) or ``clock`` (s), as far as the wire has it. What was
        seen before has to have been fed: layouts are agreed on at the start of a connection.
        """
