"""An arm that no code knows: its firmware is written after its manual, not after our map."""

import math
import threading
import time
from pathlib import Path

import can
import numpy as np
import pytest
from can_arm import MODEL, next_state, setpoint_of
from patience import PATIENCE

from gapbridge.drivers.can.driver import CanDriver
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.clock import SYSTEM

INVENTED = Path(__file__).with_name("invented.yaml")
COUNT = math.radians(0.0005)
SIGN = np.array([1, -1, 1, 1, -1, 1])
ZERO = np.array([0, 0.1, 0, 0, 0, -0.2])


class Firmware(threading.Thread):
    """Packs bits by hand: 4 of a counter (or mode), then three joints of 20, little-endian."""

    def __init__(self, channel, q):
        super().__init__(daemon=True)
        self.bus = can.Bus(interface="virtual", channel=channel)
        self.q, self.powered, self.alarm, self.ended = np.array(q), False, 0, False

    def counts(self):
        return [round(c) & 0xFFFFF for c in (self.q - ZERO) * SIGN / COUNT]

    def pack(self, nibble, joints):
        a, b, c = joints
        return (nibble | a << 4 | b << 24 | c << 44).to_bytes(8, "little")

    def unpack(self, data):
        word = int.from_bytes(data, "little")
        found = [word >> shift & 0xFFFFF for shift in (4, 24, 44)]
        return [v - (1 << 20) if v >> 19 else v for v in found], word & 0xF

    def run(self):
        count = 0
        while not self.ended:
            while (frame := self.bus.recv(0.0)) is not None:
                self.take(frame.arbitration_id, bytes(frame.data))
            counts = self.counts()
            self.send(0x18FF5010, self.pack(count, counts[:3]))
            self.send(0x18FF5011, self.pack(count, counts[3:]))
            if count % 4 == 0:
                self.send(0x701, bytes([self.alarm | self.powered << 4, 0]))
            count = (count + 1) % 16
            time.sleep(0.004)

    def take(self, identifier, data):
        if identifier == 0x200:
            self.powered = bool(data[0] & 1)
        elif identifier in (0x201, 0x202) and self.powered:
            counts, mode = self.unpack(data)
            if mode == 3:
                part = slice(0, 3) if identifier == 0x201 else slice(3, 6)
                self.q[part] = (np.array(counts) * COUNT * SIGN[part]) + ZERO[part]

    def send(self, identifier, data):
        self.bus.send(
            can.Message(arbitration_id=identifier, data=data, is_extended_id=identifier > 0x7FF)
        )


@pytest.fixture
def firmware():
    found = Firmware("invented", [0.3, -0.4, 0.5, -0.6, 0.7, -0.8])
    found.start()
    yield found
    found.ended = True
    found.join(PATIENCE)
    found.bus.shutdown()


def test_an_arm_that_no_code_knows_is_read_armed_and_moved_from_data_alone(firmware):
    settings = CanSettings(
        profile=str(INVENTED), interface="virtual", channel="invented", foreign_quiet=0.1
    )
    with CanDriver(settings, MODEL, clock=SYSTEM) as driver:
        state = next_state(driver)
        assert state.actual_q == pytest.approx(firmware.q, abs=COUNT)
        assert not firmware.powered
        driver.arm(state)
        assert firmware.powered
        goal = state.actual_q + np.linspace(-0.02, 0.02, 6)
        driver.write_setpoint(setpoint_of(goal))
        for _ in range(5):
            state = next_state(driver)
        assert firmware.q == pytest.approx(goal, abs=COUNT)
        assert state.actual_q == pytest.approx(goal, abs=COUNT)
        firmware.alarm = 2
        until = time.monotonic() + PATIENCE
        while next_state(driver).safety_mode != 7:
            assert time.monotonic() < until
