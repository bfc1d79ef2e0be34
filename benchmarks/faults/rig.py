"""A daemon, its controller, and between the two of them a proxy and a tap."""

from __future__ import annotations

import contextlib
import sys
import time
from pathlib import Path
from typing import Any, Self

from benchmarks.faults.controller_process import ControllerProcess
from benchmarks.faults.invariants import Checker, Found
from benchmarks.faults.links import Link
from benchmarks.faults.proxy import Proxy
from benchmarks.faults.punctual import Witness, be_ordinary, be_punctual
from benchmarks.faults.running import Running
from benchmarks.faults.tap import Tap
from benchmarks.ports import own_host
from gapbridge.bridge.ipc.loop_state import State

SOME = 40  # messages decoded at a time
REPORTED = 1.0  # s within which an event has come from the loop to here, on any machine
WARM_UP = 0.12  # s of compensating before a fault is made
START_LIMIT, RECOVERY_LIMIT = 180.0, 120.0  # s: on a machine that has much else to do


class Rig:
    """One link with everything around it, while the ``with`` block lasts."""

    def __init__(self, link: Link, folder: Path, more: str = "", **changed: Any) -> None:
        self.link, self._changed = link, changed
        self.front, self.back = own_host(), own_host()
        self.cell, controller_cell = link.write_cells(folder, self.front, self.back, more)
        self.controller = ControllerProcess(
            controller_cell, self.back, 30100, folder / "controller.log"
        )
        self.checker = Checker(link.bounds(self.cell))
        self.witness = Witness()
        self._runs: list[Running] = []
        self.decoder = link.decoder()
        self.tap = Tap(self.decoder, link.ports(), self._state_word)
        self.proxy = Proxy(self.front, self.back, link.ports(), self.tap.emit)

    def _state_word(self) -> int:
        return self._runs[-1].state_word() if self._runs else -1

    @property
    def run(self) -> Running:
        """Return the daemon's run of now."""
        return self._runs[-1]

    @property
    def found(self) -> Found:
        """Return what the checker has found up to now."""
        while self.check():
            time.sleep(0.0005)  # the proxy goes first: who decodes must not slow the wire
        if self.checker.suspected:
            time.sleep(REPORTED)
            self.checker.settle([span for run in self._runs for span in run.writing_spans()])
        return self.checker.found

    def check(self) -> bool:
        """Check some of what the tap has kept; returns whether there was any."""
        seen = self.tap.drain(SOME)
        self.checker.take(seen)
        return bool(self.tap.waiting)

    def __enter__(self) -> Self:
        sys.setswitchinterval(1e-4)  # the proxy's thread must not wait for others
        be_punctual()  # nor for this one, which may hold the interpreter
        try:
            self.witness.__enter__()
            self.controller.start()
            self.link.prepare(self.controller, self.back)
            self.proxy.__enter__()
            self.start_daemon()
        except BaseException:
            self.controller.stop()
            self.witness.__exit__(None, None, None)
            be_ordinary()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            if self.run.alive:
                self.controller.go_on()
                self.proxy.heal()
                self.run.stop()
        finally:
            self.proxy.__exit__(None, None, None)
            self.controller.stop()
            self.witness.__exit__(None, None, None)
            be_ordinary()

    def start_daemon(self) -> None:
        """Start a run, observing."""
        self._runs.append(Running(self.cell, **self._changed))
        self.run.start()
        self.wait(State.OBSERVING, START_LIMIT)

    def wait(self, state: State, limit: float) -> None:
        """Wait for a state of the loop. Raises TimeoutError, and what the daemon ended with."""
        until = time.monotonic() + limit
        while self.run.state != state:
            if self.run.error is not None:
                raise self.run.error
            if time.monotonic() > until:
                raise TimeoutError(
                    f"{state.name}: not within {limit:g} s; last: {self.run.last_words()}"
                )
            self.pass_time(0.002)

    def pass_time(self, seconds: float) -> None:
        """Wait, and check meanwhile what goes over the wire."""
        until = time.monotonic() + seconds
        while True:
            self.check()
            left = until - time.monotonic()
            if left <= 0.0:
                return
            time.sleep(min(0.002, left))

    # -- between faults ---------------------------------------------------------------------------

    def heal(self) -> None:
        """Undo every fault that can be undone from here."""
        self.proxy.heal()
        self.controller.go_on()
        if not self.controller.runs:
            self.controller.start()
        self.link.prepare(self.controller, self.back, self.run.state.writes)

    def recover(self, limit: float = RECOVERY_LIMIT) -> None:
        """Heal, and acknowledge faults as a person does, until the daemon observes."""
        self.heal()
        until = time.monotonic() + limit
        while (state := self.run.state) not in (State.OBSERVING, State.COMPENSATING):
            if self.run.error is not None:
                raise self.run.error
            if time.monotonic() > until:
                raise TimeoutError(f"{state.name} after {limit:g} s: {self.run.last_words()}")
            if state == State.FAULT:
                self.run.daemon.disarm()
            self.pass_time(0.02)

    def compensate(self, limit: float = RECOVERY_LIMIT) -> None:
        """Bring the daemon to where it writes, arming it as a person does."""
        until = time.monotonic() + limit
        while True:
            self.recover(limit)
            if self.run.state != State.COMPENSATING:
                self.run.daemon.arm()
            with contextlib.suppress(TimeoutError):
                self.wait(State.COMPENSATING, 2.0)
                self.pass_time(WARM_UP)
            if self.run.state == State.COMPENSATING:
                return
            if time.monotonic() > until:
                raise TimeoutError(f"cannot be armed: {self.run.last_words()}")
