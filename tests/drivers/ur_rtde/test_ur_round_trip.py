"""The round trip to an RTDE server: what it is, and that none at all is one line."""

from __future__ import annotations

import socket
import threading
import time

import pytest
from clock_by_hand import ByHand
from simulated_controller import SimulatedController

from gapbridge.core.errors import WriteError
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.ur_rtde import enquiry
from gapbridge.drivers.ur_rtde.enquiry import ASK_EVERY, RoundTrip

DELAY = 0.06  # s


def test_a_server_beside_us_answers_within_milliseconds(controller: SimulatedController) -> None:
    assert 0.0 < RoundTrip(controller.host, SYSTEM).measure() < 0.02


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
    assert DELAY <= RoundTrip("127.0.0.1", SYSTEM).measure() < DELAY + 0.05


@pytest.mark.parametrize("answers", [0, 1])
def test_no_answer_is_one_line(monkeypatch: pytest.MonkeyPatch, answers: int) -> None:
    monkeypatch.setattr(enquiry, "RTDE", slow_server(0.0, answers))
    with pytest.raises(WriteError, match=r"127.0.0.1: found no answer on RTDE's port"):
        RoundTrip("127.0.0.1", SYSTEM).measure()


def polled(question: RoundTrip, clock: ByHand, seconds: float) -> list[float]:
    """Return what polling gives, as a loop polls that runs by a clock of its own."""
    found = []
    for _ in range(round(seconds / 0.01)):
        clock.sleep(0.01)
        time.sleep(0.001)  # the server answers in real time
        round_trip = question.poll()
        if round_trip is not None:
            found.append(round_trip)
    return found


def test_a_round_trip_is_measured_again_without_waiting(controller: SimulatedController) -> None:
    clock = ByHand()
    question = RoundTrip(controller.host, clock)
    assert polled(question, clock, 0.1) == []  # nothing before it was measured
    question.measure()
    found = polled(question, clock, 100 * ASK_EVERY)
    assert 20 < len(found) <= 100
    assert min(found) == pytest.approx(0.01)
    question.close()
    assert polled(question, clock, 2 * ASK_EVERY) == []


def test_polling_a_server_that_hangs_up_gives_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(enquiry, "RTDE", slow_server(0.0, enquiry.TRIES))
    clock = ByHand()
    question = RoundTrip("127.0.0.1", clock)
    question.measure()
    assert polled(question, clock, 4 * ASK_EVERY) == []
