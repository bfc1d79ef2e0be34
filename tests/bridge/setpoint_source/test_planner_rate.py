"""A planner's lines are counted against the robot's cycles, by this machine's clock."""

from __future__ import annotations

import socket

import pytest
from clock_by_hand import ByHand

from gapbridge.bridge.setpoint_source.planner import Connection

RATE = 20.0  # Hz of the robot's cycles
LONG = 600.0  # s


@pytest.mark.parametrize(("ratio", "refused"), [(1.0, False), (1.015, False), (1.2, True)])
def test_a_planner_that_goes_by_the_robots_faster_clock_is_never_too_fast(
    ratio: float, refused: bool
) -> None:
    """With one line per cycle it would use its credit up within hours."""
    clock = ByHand()
    ours, theirs = socket.socketpair()
    connection = Connection(ours, RATE, clock)
    taken = 0
    with theirs:
        while not connection.closed and taken < LONG * RATE:
            clock.sleep(1.0 / (ratio * RATE))
            theirs.send(b"0,0,0\n")
            taken += len(connection.lines())
        assert connection.closed == refused
        if refused:
            assert (
                theirs.recv(200)
                == b"error: found more than 20 lines per second, the robot's rate\n"
            )
    connection.close()
