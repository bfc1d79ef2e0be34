"""Wires in memory: one direction each, with what a network does to messages."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Generic, TypeVar

from benchmarks.simulation.world import World

Message = TypeVar("Message")
WAY = 2e-4  # s that a message is under way


class Wire(Generic[Message]):
    """Messages one after the other, each a moment under way.

    ``ordered``: what leaves later arrives later, as with TCP. A wire that holds hands all it has on
    at once when it is let go; one that is cut loses what is on it.
    """

    def __init__(
        self, world: World, deliver: Callable[[Message], None], ordered: bool = True
    ) -> None:
        self._world, self._deliver, self._ordered = world, deliver, ordered
        self._newest = 0.0
        self._generation = 0
        self.heal()

    def heal(self) -> None:
        """Be as a quiet network is."""
        self.delay, self.jitter = WAY, 5e-5
        self.growth, self._grows_since = 0.0, 0.0  # s per s, s
        self.held_until = 0.0
        self.lost = self.doubled = 0.0  # share of messages
        self.change: Callable[[Message], Message] | None = None
        self.changed = 0  # messages still to be changed
        self.is_cut = False

    def hold(self, seconds: float) -> None:
        """Keep what is sent, and hand it on all at once."""
        self.held_until = self._world.now + seconds

    def grow(self, growth: float) -> None:
        """Have the delay grow from now on, s per s."""
        self.growth, self._grows_since = growth, self._world.now

    @property
    def delay_now(self) -> float:
        """Return how long a message is under way, without jitter, s."""
        return self.delay + self.growth * (self._world.now - self._grows_since)

    def cut(self) -> None:
        """Lose what is under way, and all that is sent."""
        self.is_cut = True
        self._generation += 1

    def send(self, message: Message) -> None:
        """Put a message on its way."""
        world = self._world
        if self.is_cut or (self.lost and world.random.random() < self.lost):
            return
        if self.changed > 0 and self.change is not None:
            self.changed -= 1
            message = self.change(message)
        times = 2 if self.doubled and world.random.random() < self.doubled else 1
        for _ in range(times):
            now, held = world.now, self.held_until
            at = now if now > held else held
            at += self.delay_now + self.jitter * world.random.random()
            if self._ordered:
                at = self._newest = at if at > self._newest else self._newest
            world.at(at, partial(self._arrive, message, self._generation))

    def _arrive(self, message: Message, generation: int) -> None:
        if generation == self._generation:
            self._deliver(message)
