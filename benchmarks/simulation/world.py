"""Simulated time, and processes that take turns in it."""

from __future__ import annotations

import heapq
import itertools
import math
import random
import sys
import threading
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from greenlet import getcurrent, greenlet

from gapbridge.drivers.clock import Clock

BEGIN = 1000.0  # s: no moment is zero by accident
EPOCH = 1.7e9  # s between the monotonic clock and the calendar
SLACK = 4e-4  # s by which the system wakes a process late, on average
ROOT = Path(__file__).parents[2]
PRODUCT = f"{ROOT / 'gapbridge'}/"


class KilledError(BaseException):
    """A process has been killed: what it was in the middle of stays as it is."""


class World:
    """Events in the order of their time; one seed decides everything that is drawn."""

    def __init__(self, seed: int) -> None:
        self.now = BEGIN
        self.random = random.Random(seed)
        self.current: Process | None = None
        self.processes: list[Process] = []
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._until = BEGIN  # s: how far time passes now

    def at(self, time: float, act: Callable[[], None]) -> None:
        """Have something happen at a time (s), now at the earliest."""
        now = self.now
        heapq.heappush(self._events, (time if time > now else now, next(self._order), act))

    def after(self, seconds: float, act: Callable[[], None]) -> None:
        """Have something happen in so many seconds."""
        self.at(self.now + seconds, act)

    def every(self, period: Callable[[], float], act: Callable[[], None]) -> None:
        """Have something happen again and again; ``period`` (s) is asked each time."""

        def again() -> None:
            act()
            self.after(period(), again)

        self.after(period(), again)

    def run(self, until: float, over: Callable[[], bool] = lambda: False) -> None:
        """Let time pass up to ``until`` (s), or until ``over``."""
        events, before = self._events, self._until
        self._until = until
        while events and events[0][0] <= until and not over():
            self.now, _, act = heapq.heappop(events)
            act()
        if not over():
            self.now = max(self.now, until)
        self._until = before

    def pass_to(self, time: float) -> bool:
        """Let time pass where nothing happens before ``time`` (s); return whether it has."""
        if time > self._until or (self._events and self._events[0][0] <= time):
            return False
        if time > self.now:
            self.now = time
        return True

    def end(self) -> None:
        """Give back what processes still hold."""
        self._events.clear()
        for process in self.processes:
            process.kill()
            process.unwind()


class Process:
    """One thread of execution with the world's time: it runs until it waits."""

    def __init__(self, world: World, name: str, main: Callable[[], Any]) -> None:
        self.world, self.name, self._main = world, name, main
        self.result: Any = None
        self.error = ""  # the traceback that it ended with
        self.raised: BaseException | None = None
        self.over = self.dead = False
        self._frozen_until = 0.0
        self._stands = False  # still at a line, while others go on
        self._ticket = 0
        self._begin_tracing: Callable[[], None] | None = None
        self._greenlet = greenlet(self._run)
        world.processes.append(self)
        world.at(world.now, partial(self._resume, 0))

    def _run(self) -> None:
        try:
            self.result = self._main()
        except KilledError:
            pass
        except BaseException as error:
            self.raised, self.error = error, traceback.format_exc()
        finally:
            sys.settrace(None)
        self.over = True

    def _resume(self, ticket: int) -> None:
        world = self.world
        if self.over or self.dead or self._stands or ticket != self._ticket:
            return  # one that stands still at a line waits for nothing
        if world.now < self._frozen_until:
            world.at(self._frozen_until, partial(self._resume, ticket))
            return
        before, world.current = world.current, self
        self._greenlet.parent = getcurrent()
        self._greenlet.switch()
        world.current = before

    def sleep(self, seconds: float) -> None:
        """Wait; only from within."""
        self._ticket += 1
        world = self.world
        wakes = world.now + seconds
        if wakes < self._frozen_until or not world.pass_to(wakes):
            world.at(wakes, partial(self._resume, self._ticket))
            parent = self._greenlet.parent
            assert parent is not None
            tracing = sys.gettrace()
            sys.settrace(None)  # of this process only: all others run at their full speed
            parent.switch()
            sys.settrace(tracing)
            self.check()
        if self._begin_tracing is not None:
            begin, self._begin_tracing = self._begin_tracing, None
            begin()

    def check(self) -> None:
        """Go no further where it has been killed meanwhile. Raises KilledError."""
        if self.dead:
            raise KilledError

    def _stay(self) -> None:
        """Go no further where it has just been killed: not even its ``finally`` happens."""
        parent = self._greenlet.parent
        if self.dead and parent is not None:
            parent.switch()  # until ``unwind``

    def wake(self) -> None:
        """End its waiting now; from outside."""
        if not self.over and not self.dead:
            self._ticket += 1
            self.world.at(self.world.now, partial(self._resume, self._ticket))

    def freeze(self, seconds: float) -> None:
        """Have it stand still from its next waiting on (SIGSTOP)."""
        self._frozen_until = max(self._frozen_until, self.world.now + seconds)

    def kill(self) -> None:
        """End it where it is: nothing more of it happens (SIGKILL)."""
        self.dead = True

    def unwind(self) -> None:
        """Give its frames back, after everything has been judged."""
        if not self.over and self._greenlet:
            self._greenlet.parent = getcurrent()
            self._greenlet.throw(KilledError)

    def at_line(self, lines: int, act: Callable[[], None]) -> None:
        """Have ``act`` happen in it, so many lines of the product after its next waiting."""
        left = [lines]

        def on_line(frame: FrameType, event: str, arg: object) -> Any:
            if event == "line":
                left[0] -= 1
                if left[0] <= 0:
                    sys.settrace(None)
                    frame.f_trace = None
                    act()
                    self._stay()
                    return None
            return on_line

        def on_call(frame: FrameType, event: str, arg: object) -> Any:
            in_product = frame.f_code.co_filename.startswith(PRODUCT)
            return on_line if left[0] > 0 and in_product else None

        self._begin_tracing = lambda: sys.settrace(on_call)

    def stand_still(self, seconds: float) -> None:
        """Stand still right here while the world goes on; only from within."""
        world, mine = self.world, self
        self._stands, world.current = True, None
        try:
            world.run(world.now + seconds)
        finally:
            self._stands, world.current = False, mine


class SimulatedClock(Clock):
    """The world's time, for whoever is running."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.calendar = EPOCH  # s since 1970 at which the monotonic clock was zero
        self.monotonic = lambda: world.now
        self.time = lambda: self.calendar + world.now
        self.sleep = self._sleep

    def _sleep(self, seconds: float) -> None:
        process = self.world.current
        assert process is not None, "only processes wait"
        late = -SLACK * math.log(1.0 - self.world.random.random())
        process.sleep(seconds + late if seconds > 0.0 else late)

    def wait(self, event: threading.Event, seconds: float) -> bool:
        """Wait until an event is set, ``seconds`` at most; return whether it is."""
        if not event.is_set():
            self._sleep(seconds)
        return event.is_set()
