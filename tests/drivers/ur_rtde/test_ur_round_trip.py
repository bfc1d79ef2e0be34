"""The round trip to an RTDE server: what it is, and that none at all is one line."""

from __future__ import annotations

import socket
import threading
import time

import pytest
from simulated_controller import SimulatedController

from gapbridge.core.errors import WriteError
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.ur_rtde import enquiry
from gapbridge.drivers.ur_rtde.enquiry import round_trip

DELAY = 0.06  # s


def test_a_server_beside_us_answers_within_milliseconds(controller: SimulatedController) -> None:
    assert 0.0 < round_trip(controller.host, SYSTEM) < 0.02


def slow_server(delay: float, answers: int) -> int:
    """Answer questions late, with a sample of RTDE's own before each; returns the port."""
    listening = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        link, _ = listening.accept()
        with link, listening:
            for k in range(answers):
                assert link.recv(64) == b"\x00\x05V\x00\x02"
                time.sleep(delay if k != 1 else 0.0)  # one that is quick counts for nothing
                link.sendall(b"\x00\x05U\x01\x02" + b"\x00\x04V\x01")

    threading.Thread(target=serve, daemon=True).start()
    return int(listening.getsockname()[1])


def test_a_long_way_counts_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(enquiry, "RTDE", slow_server(DELAY, enquiry.TRIES))
    assert DELAY <= round_trip("127.0.0.1", SYSTEM) < DELAY + 0.05


@pytest.mark.parametrize("answers", [0, 1])
def test_no_answer_is_one_line(monkeypatch: pytest.MonkeyPatch, answers: int) -> None:
    monkeypatch.setattr(enquiry, "RTDE", slow_server(0.0, answers))
    with pytest.raises(WriteError, match=r"127.0.0.1: found no answer on RTDE's port"):
        round_trip("127.0.0.1", SYSTEM)
