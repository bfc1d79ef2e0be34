"""An arm that no code knows: its firmware is written after its manual, not after our map."""

import math
import shutil
import threading
import time
from pathlib import Path

import can
import numpy as np
import pytest
from can_arm import MODEL, next_state, setpoint_of
from patience import PATIENCE

from gapbridge.core.errors import InputError
from gapbridge.drivers.can.driver import CanDriver
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.simulated.can.server import make_servers
from gapbridge.drivers.simulated.server.arm_controller import make_controller
from gapbridge.drivers.simulated.ur.settings import simulated_arm

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


@pytest.mark.parametrize(
    ("status", "reasons"),
    [
        ("normal: [1]", ("fault", "fault")),
        ("normal: [0, 1]", ("fault", "fault")),
        ("normal: [0], values: {2: emergency_stop, 5: protective_stop}",
         ("emergency_stop", "protective_stop")),
        ("normal: [0], values: {2: emergency_stop}", ("emergency_stop", "fault")),
    ],
)  # fmt: skip
@pytest.mark.parametrize("shared", [False, True])
def test_an_arm_simulated_from_its_map_reports_its_stops(
    tmp_path: Path, status: str, reasons: tuple[str, str], shared: bool
) -> None:
    """``shared``: the same signal says whether the motors are enabled."""
    text = INVENTED.read_text().replace("normal: [0], values: {2: emergency_stop}", status)
    text = text.replace("Health.powered", "Health.alarm") if shared else text
    (tmp_path / "arm.yaml").write_text(text)
    shutil.copy(INVENTED.with_suffix(".dbc"), tmp_path)
    settings = CanSettings(profile=str(tmp_path / "arm.yaml"), interface="virtual")
    controller = make_controller(*simulated_arm(MODEL.arm, seed=5), period=0.004)
    (node,) = make_servers(settings, "127.0.0.2", controller)
    profile = node._profile
    health = next(message for message in profile.incoming.values() if message.name == "Health")

    def reported() -> object:
        values = health.decode(node._encode(health, controller))
        return health.checks[0].stop_reason(int(values["alarm"]))

    assert shared or reported() is None
    controller.emergency_stop()
    assert reported() == reasons[0]
    controller.release_emergency_stop()
    controller.protective_stop()
    assert reported() == reasons[1]


def test_a_simulated_serial_adapter_leaves_somebody_elses_link_alone(tmp_path: Path) -> None:
    channel = tmp_path / "by-id"
    channel.symlink_to(tmp_path / "the real adapter")
    settings = CanSettings(profile="piper", interface="slcan", channel=str(channel))
    controller = make_controller(*simulated_arm(MODEL.arm, seed=5), period=0.004)
    (node,) = make_servers(settings, "127.0.0.2", controller)
    try:
        with pytest.raises(InputError, match="by-id, expected a name that is free"):
            node.open(controller, SYSTEM)
    finally:
        node.close()
    assert channel.readlink() == tmp_path / "the real adapter"
