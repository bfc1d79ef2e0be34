"""Two loops never have one controller, though the daemon of the first was killed."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from clock_by_hand import ByHand
from daemon_cell import Robot, Run
from patience import wait_for

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.run_settings import settings_of
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.loop.claimed_controller import LONGEST_WAIT, claimed_controller
from gapbridge.core.errors import LinkError
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.controller_address import address_of

ADDRESS = f"host 192.0.2.21 of {os.getpid()}"  # no other checkout's


class Ends(ByHand):
    """A clock by which another loop ends after some seconds."""

    def __init__(self, other: socket.socket, after: float) -> None:
        super().__init__()
        self.sleep = self._pass_and_end
        self._other, self._end = other, self.now + after

    def _pass_and_end(self, seconds: float) -> None:
        self._pass(seconds)
        if self.now >= self._end:
            self._other.close()


@pytest.fixture
def other() -> Iterator[socket.socket]:
    with claimed_controller(ADDRESS, no_event, ByHand()) as claimed:
        yield claimed


def no_event(event: dict[str, Any]) -> None:
    raise AssertionError(event)


def test_a_loop_waits_for_the_one_that_ramps_out_and_says_so_once(other: socket.socket) -> None:
    clock, events = Ends(other, 12.0), []
    claimed_controller(ADDRESS, events.append, clock).close()
    assert clock.now == pytest.approx(112.0, abs=0.1)
    (event,) = events
    assert event["kind"] == "note"
    assert f"{ADDRESS} is still held by the loop of a daemon that was killed" in event["detail"]


def test_another_controller_is_not_waited_for(other: socket.socket) -> None:
    clock = ByHand()
    claimed_controller(f"{ADDRESS}2", no_event, clock).close()
    assert clock.now == ByHand().now


def test_a_loop_that_does_not_end_is_a_failure_at_run_time(other: socket.socket) -> None:
    clock, events = ByHand(), []
    with pytest.raises(LinkError, match=f"link: {ADDRESS} is still held .* within 60 s"):
        claimed_controller(ADDRESS, events.append, clock)
    assert clock.now == pytest.approx(100.0 + LONGEST_WAIT, abs=0.1)


def test_a_daemons_loop_does_not_connect_before_the_other_has_ended(tmp_path: Path) -> None:
    with Robot(tmp_path) as robot:
        cell = robot.cell()
        address = address_of(settings_of(load_cell(cell)).link)
        with claimed_controller(address, no_event, SYSTEM) as other, Run(cell) as run:

            def waits() -> bool:
                return any("is still held by the loop" in line for line in run.output)

            wait_for(lambda: waits() or run.daemon.memory.has_state, "the note, or a state")
            assert waits()
            assert not run.daemon.memory.has_state
            other.close()
            run.wait(State.OBSERVING)
