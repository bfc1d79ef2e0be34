"""What leaves for the bus where a frame does not, without a bus."""

from __future__ import annotations

import can
import numpy as np
import pytest

from gapbridge.core.errors import PartialWriteError, WriteError
from gapbridge.drivers.can.loading import read_profile
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.can.writer import FrameWriter
from gapbridge.drivers.clock import SYSTEM, Clock


class Bus:
    """Takes frames, but not the one with number ``fails``."""

    fails = -1

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes]] = []
        self.asked = 0

    def send(self, frame: can.Message, timeout: float) -> None:
        self.asked += 1
        if self.asked == self.fails:
            raise can.CanOperationError("no room in the transmit queue")
        self.sent.append((frame.arbitration_id, bytes(frame.data)))

    def begin(self, fails: int) -> None:
        self.sent, self.asked, self.fails = [], 0, fails


@pytest.fixture
def opened() -> tuple[FrameWriter, Bus]:
    profile, bus = read_profile(CanSettings.shipped / "piper.yaml"), Bus()
    writer = FrameWriter(CanSettings(profile="piper"), profile, SYSTEM)
    writer.use(bus)
    return writer, bus


@pytest.mark.parametrize("again", [False, True])
def test_half_a_setpoint_is_replaced_by_one_of_this_session_or_by_a_stop(
    opened: tuple[FrameWriter, Bus], again: bool
) -> None:
    """One of a session before may be anywhere."""
    writer, bus = opened
    writer.write(np.zeros(6))
    before = bus.sent
    if again:
        writer.reset()
    bus.begin(fails=2)
    words = "the stop sequence was sent" if again else "the setpoint before was sent again"
    with pytest.raises(PartialWriteError, match=f"1 of {len(before)} frames out; {words}"):
        writer.write(np.full(6, 0.1))
    stop = [(key[0], data) for key, data in writer._stop_frames()]
    assert bus.sent[1:] == (stop if again else before)
    assert writer.reverted == 1


def test_the_target_is_the_last_setpoint_that_left_whole(
    opened: tuple[FrameWriter, Bus],
) -> None:
    writer, bus = opened
    q = np.zeros(6)
    writer.write(q)
    q += 0.1  # the limiter's memory is used again
    bus.begin(fails=1)
    with pytest.raises(PartialWriteError, match="nothing of it was sent"):
        writer.write(q)
    assert writer.target is not None
    np.testing.assert_array_equal(writer.target, np.zeros(6))


def test_a_sequence_that_comes_to_no_end_is_given_up_in_time() -> None:
    profile = read_profile(CanSettings.shipped / "piper.yaml")
    now, clock = [0.0], Clock()
    clock.monotonic = lambda: now[0]
    writer = FrameWriter(CanSettings(profile="piper"), profile, clock)
    writer.use(Bus())
    action = next(a for a in profile.enable if a.until is not None)

    def listen(seconds: float) -> None:
        now[0] += seconds
        assert now[0] < 2 * action.within + 1.0

    with pytest.raises(WriteError, match=f"not {action.until} after {action.within:g} s"):
        writer.run([action], lambda: np.zeros(6), listen, lambda _: False)
    assert now[0] <= action.within + 2 * action.every
