from __future__ import annotations

import math
import socket
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import pytest
from patience import PATIENCE
from rtde_client import RtdeClient
from simulated_cell import Bench
from simulated_controller import SimulatedController

from gapbridge.drivers.simulated.ur.programs.offset_program import checksum

OUT = ",".join(
    ["timestamp", "output_int_register_12", "output_int_register_13"]
    + ["actual_TCP_pose", "actual_q", "target_q"]
    + [f"output_double_register_{i}" for i in range(12, 18)]
)
IN = ",".join(
    [f"input_double_register_{i}" for i in range(18, 23)]
    + [f"input_int_register_{i}" for i in range(18, 23)]
)
RATES = 1250 << 16 | 1000  # 50 mm/s, 0.1 rad/s
OFFSET = (1.0e-3, -5.0e-4, 2.0e-3, 1.0e-3, 0.0, -2.0e-3)


class Stream:
    """A client that streams offsets as the driver does."""

    def __init__(self, host: str) -> None:
        self.client = RtdeClient(host)
        self.client.outputs(OUT)
        self.recipe, _ = self.client.inputs(IN)
        self.client.start()
        self.sequence = 0
        self.beat = 0

    def send(
        self, offset: tuple[float, ...], spoil: int = 0, beat: bool = True, rates: int = RATES
    ) -> None:
        self.sequence += 1
        self.beat += beat
        rz = round(offset[5] * 1e9)
        total = checksum((*offset[:5], rz * 1e-9), self.sequence, rates)
        self.client.write(
            self.recipe, "5d5i", *offset[:5], rz, self.sequence, total + spoil, self.beat, rates
        )

    def hold(self, offset: tuple[float, ...], cycles: int) -> dict[str, Any]:
        """Send an offset for so many cycles, and on until it is applied, echoed and reached.

        A busy machine that lets the heartbeat rest begins the ramp anew, and the arm follows late.
        """
        samples = [self._cycle(offset) for _ in range(cycles)]
        begun = time.monotonic()
        while not (
            samples[-1]["output_int_register_12"] >= self.sequence - 2
            and samples[-1]["output_int_register_13"] == 1
            and applied(samples[-1]) == pytest.approx(offset, abs=1e-12)
            and samples[-1]["actual_q"] == pytest.approx(samples[-2]["actual_q"], abs=1e-10)
        ):
            assert time.monotonic() - begun < PATIENCE, samples[-1]
            samples.append(self._cycle(offset))
        return samples[-1]

    def _cycle(self, offset: tuple[float, ...]) -> dict[str, Any]:
        self.send(offset)
        return self.client.sample()

    def wait(self, cycles: int) -> dict[str, Any]:
        for _ in range(cycles):
            sample = self.client.sample()
        return sample

    def until(self, status: int) -> dict[str, Any]:
        """Return the first sample with a status; on a busy machine it comes a while later."""
        begun = time.monotonic()
        while (sample := self.client.sample())["output_int_register_13"] != status:
            assert time.monotonic() - begun < PATIENCE, sample
        return sample


def applied(sample: dict[str, Any]) -> list[float]:
    return [sample[f"output_double_register_{i}"] for i in range(12, 18)]


def shift(before: dict[str, Any], after: dict[str, Any]) -> list[float]:
    pair = zip(before["actual_TCP_pose"][:3], after["actual_TCP_pose"][:3], strict=True)
    return [b - a for a, b in pair]


@pytest.fixture
def stream(controller: SimulatedController) -> Iterator[Stream]:
    upload = socket.create_connection((controller.host, 30003), timeout=PATIENCE)
    upload.sendall(b"def gapbridge_offset():\n  while True:\n    sync()\n  end\nend\n")
    found = Stream(controller.host)
    found.wait(60)
    yield found
    found.client.close()
    upload.close()


def test_an_offset_is_applied_in_base_axes_and_echoed(stream: Stream) -> None:
    before = stream.client.sample()
    after = stream.hold(OFFSET, 200)
    moved = shift(before, after)
    assert moved == pytest.approx(OFFSET[:3], abs=1e-8)
    assert after["target_q"] != before["target_q"]
    assert after["actual_q"] == pytest.approx(after["target_q"], abs=1e-6)


def test_offsets_are_ramped_never_jumped(stream: Stream) -> None:
    lengths = [0.0]
    begun = time.monotonic()
    while lengths[-1] < 5.0e-3 - 1e-12:
        stream.send((5.0e-3, 0.0, 0.0, 0.0, 0.0, 0.0))
        lengths.append(applied(stream.client.sample())[0])
        assert time.monotonic() - begun < PATIENCE, lengths
    steps = [b - a for a, b in pairwise(lengths)]
    assert 1.0e-4 - 1e-12 <= max(steps) <= 2.0e-4 + 1e-12  # at full rate, however often begun anew


def test_a_wrong_checksum_is_rejected_until_a_good_one_comes(stream: Stream) -> None:
    good = stream.hold(OFFSET, 100)
    accepted = good["output_int_register_12"]
    stream.send((9.0e-3, 0.0, 0.0, 0.0, 0.0, 0.0), spoil=1)
    bad = stream.until(3)
    assert bad["output_int_register_12"] in (accepted, accepted + 1, accepted + 2)
    assert applied(bad) == pytest.approx(OFFSET, abs=1e-12)
    stream.hold(OFFSET, 10)
    stream.until(1)


def test_an_offset_that_is_no_number_is_rejected(stream: Stream) -> None:
    stream.sequence += 1
    stream.client.write(
        stream.recipe, "5d5i", math.nan, 0, 0, 0, 0, 0, stream.sequence, 0, 5, RATES
    )
    assert applied(stream.until(3)) == [0.0] * 6


def test_without_a_heartbeat_the_offset_goes_to_zero(stream: Stream) -> None:
    stream.hold(OFFSET, 100)
    stream.until(2)
    assert applied(stream.wait(60)) == [0.0] * 6
    stream.hold(OFFSET, 100)


def test_the_robots_own_motion_goes_on_under_the_offset(
    stream: Stream, controller: SimulatedController, bench: Bench
) -> None:
    start = controller.settings.start_q
    stream.hold(OFFSET, 100)
    bench.do("move 0.2 " + " ".join(map(str, start[1:])))
    moved = stream.hold(OFFSET, 800)
    assert abs(moved["actual_q"][0] - 0.2) < 0.01
    plain = stream.hold((0.0,) * 6, 200)
    assert plain["actual_q"] == pytest.approx((0.2, *start[1:]), abs=1e-7)
    assert shift(plain, moved) == pytest.approx(OFFSET[:3], abs=1e-7)


def test_stopping_the_program_leaves_no_state_behind(
    stream: Stream, controller: SimulatedController
) -> None:
    stream.hold(OFFSET, 50)
    dashboard = socket.create_connection((controller.host, 29999), timeout=PATIENCE)
    dashboard.sendall(b"stop\n")
    assert applied(stream.until(0)) == [0.0] * 6
    dashboard.close()
