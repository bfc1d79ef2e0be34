"""What a request to disarm acknowledges: what was known when it was made."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest

from gapbridge.bridge.daemon.requests import Requests
from gapbridge.bridge.daemon.status import DaemonStatus
from gapbridge.bridge.daemon.zero_watch import ZeroWatch
from gapbridge.bridge.ipc.command_memory import Command, CommandMemory
from gapbridge.bridge.ipc.shared_memory import slices_of
from gapbridge.drivers.clock import SYSTEM

SLIP = {"kind": "slip", "detail": "joint 3 slipped"}
OTHER = {"kind": "slip", "detail": "joint 5 slipped"}
FAILED = {"kind": "verification", "holds": False, "detail": "the tool moved"}


@dataclass
class Bench:
    """A daemon's requests and what they act on, without a loop."""

    commands: CommandMemory = field(default_factory=CommandMemory)
    status: DaemonStatus = field(default_factory=lambda: DaemonStatus(slices_of(6), SYSTEM))
    asked: list[tuple[Command, bool, bool]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.requests = Requests(
            self.commands, self.status.on_event, lambda: self.status.unacknowledged, self._note
        )
        self.watch = ZeroWatch.__new__(ZeroWatch)  # only what holds is used
        self.watch._emit, self.watch._commands = self.status.on_event, self.commands

    def _note(self, *given: Any) -> str:
        self.asked.append(given)
        return ""

    def find(self, event: dict[str, Any]) -> None:
        self.watch._hold(event)

    def disarm(self) -> int:
        return self.requests.make(Command.DISARM, "a person")


@pytest.fixture
def bench() -> Iterator[Bench]:
    found = Bench()
    yield found
    found.commands.close()


@pytest.mark.parametrize("known", [None, OTHER, FAILED])
def test_a_slip_that_is_found_after_it_was_made_stays(
    bench: Bench, known: dict[str, Any] | None
) -> None:
    if known is not None:
        bench.find(known)
    made = bench.disarm()  # of what is known, or of a fault
    bench.find(SLIP)
    bench.requests.forward()
    assert bench.status.unacknowledged[1] == SLIP["detail"]
    assert bench.asked == [(Command.DISARM, True, False)]
    assert bench.commands.last_of(Command.DISARM) == made  # it ramps out all the same
    assert bench.commands.last_of(Command.ZERO_MOVED) > made
    again = bench.disarm()  # by who has seen it
    bench.requests.forward()
    assert bench.status.unacknowledged[1] == ""
    assert bench.asked[1:] == [(Command.DISARM, True, True)]
    assert bench.commands.last_of(Command.ZERO_MOVED) < again


def test_what_is_gone_when_it_is_passed_on_keeps_nothing_latched(bench: Bench) -> None:
    bench.find(FAILED)
    bench.find(SLIP)
    bench.disarm()
    bench.status.on_event({**FAILED, "holds": True})
    bench.requests.forward()
    assert bench.status.unacknowledged == ("", "")


def test_who_answers_an_event_has_a_higher_number_than_the_hold_for_it(bench: Bench) -> None:
    made: list[int] = []
    bench.watch._emit = lambda event: (bench.status.on_event(event), made.append(bench.disarm()))
    bench.find(SLIP)
    bench.requests.forward()
    assert bench.commands.last_of(Command.ZERO_MOVED) < made[0]
    assert bench.status.unacknowledged == ("", "")
