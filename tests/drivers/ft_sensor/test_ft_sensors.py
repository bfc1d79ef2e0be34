"""Each sensor over its real wire: units, signs, overload, silence, garbage."""

from __future__ import annotations

import struct
import termios
import threading
import time
from typing import Any

import can
import numpy as np
import pytest
import serial
from patience import PATIENCE, wait_for
from pymodbus.framer import FramerRTU
from sensor_wires import (
    COG,
    KINDS,
    MASS,
    RESOLUTION,
    RPY,
    XYZ,
    Reaction,
    Wire,
    flange_rotation,
    make_wire,
    next_reading,
    reaction_of,
    resting_controller,
    settings_of,
)

from gapbridge.core.errors import LinkError
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.ft_sensor import FT_SENSORS, make_sensor
from gapbridge.drivers.ft_sensor.can_sensor import CanSensor
from gapbridge.drivers.ft_sensor.joined import sensor_to_flange
from gapbridge.drivers.simulated.ft_sensor.ati_node import AtiNode, RobotousNode
from gapbridge.drivers.simulated.ft_sensor.ft300_device import Ft300Device

TURNED = (0.3, -1.2, 1.4, -1.1, -1.3, 0.8)  # rad
GRAVITY = 9.80665


def tolerance(kind: str) -> np.ndarray[Any, Any]:
    force, torque = RESOLUTION[kind]
    return np.array(3 * (force,) + 3 * (torque,))


@pytest.mark.parametrize("kind", KINDS)
def test_a_known_wrench_is_read_in_newtons_and_newton_metres(kind: str) -> None:
    reaction = Reaction()
    wire = make_wire(kind, reaction)
    with wire.device, make_sensor(wire.settings(), SYSTEM) as sensor:
        reading = next_reading(sensor)
        assert np.all(np.abs(reading.wrench - reaction.wrench) <= tolerance(kind))
        assert reading.status == 0
        assert reading.timestamp <= reading.received <= time.monotonic()
        reaction.wrench = tuple(-v for v in reaction.wrench)
        until = time.monotonic() + PATIENCE
        while np.any(np.abs(reading.wrench - reaction.wrench) > tolerance(kind)):
            assert time.monotonic() < until, reading
            reading = next_reading(sensor)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sign", [1, -1])
def test_a_mass_at_rest_reads_its_weight_pointing_down(kind: str, sign: int) -> None:
    controller = resting_controller(TURNED)
    wire = make_wire(kind, reaction_of(controller, sign))
    wire.keys |= {"sensor_in_flange": {"xyz": XYZ, "rpy": RPY}, "sign": sign}
    with wire.device, make_sensor(wire.settings(), SYSTEM) as sensor:
        reading = next_reading(sensor)
    in_flange = sensor_to_flange(wire.settings().sensor_in_flange) @ reading.wrench
    rotation = flange_rotation(TURNED)
    weight = rotation.T @ (0.0, 0.0, -MASS * GRAVITY)
    expected = np.concatenate([weight, np.cross(COG, weight)])
    assert np.all(np.abs(in_flange - expected) <= 3.0 * tolerance(kind))
    assert (rotation @ in_flange[:3])[2] == pytest.approx(-MASS * GRAVITY, abs=0.1)


def test_the_constructor_touches_no_wire_and_the_table_is_whole() -> None:
    keys: dict[str, dict[str, Any]] = {
        "robotous_rft": {"interface": "socketcand", "port": 9},
        "ati_netcanoem": {"interface": "socketcand", "port": 9},
        "robotiq_ft300": {"port": "/dev/nothing-here"},
    }
    assert set(keys) == set(FT_SENSORS)
    for name, more in keys.items():
        sensor = make_sensor(settings_of(driver=name, **more), SYSTEM)
        with pytest.raises(LinkError, match=name):
            sensor.read(0.01)
        with pytest.raises(LinkError):
            sensor.connect()
        sensor.close()
        sensor.close()


@pytest.mark.parametrize("kind", ["robotous_rft", "ati_netcanoem"])
def test_overload_bits_are_reported(kind: str) -> None:
    wire = make_wire(kind, Reaction())
    wire.device.status = 0x2000 if kind == "ati_netcanoem" else 0x04
    with wire.device, make_sensor(wire.settings(), SYSTEM) as sensor:
        reading = next_reading(sensor)
        assert reading.status == wire.device.status
        phrase = sensor.describe(reading.status)
    assert ("DAC" if kind == "ati_netcanoem" else "overload") in phrase


def test_a_saturated_gauge_is_overload() -> None:
    wire = make_wire("ati_netcanoem", Reaction((900.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
    with wire.device, make_sensor(wire.settings(), SYSTEM) as sensor:
        reading = next_reading(sensor)
        assert "saturated" in sensor.describe(reading.status)


def test_a_sensor_calibrated_in_pounds_is_read_in_newtons() -> None:
    reaction = Reaction()
    wire = make_wire("ati_netcanoem", reaction)
    assert isinstance(wire.device, AtiNode)
    pounds = AtiNode(
        reaction, wire.device._settings, seed=9, units=((1, 4.4482216), (2, 1.3558179))
    )
    with pounds, make_sensor(wire.settings(), SYSTEM) as sensor:
        assert np.all(
            np.abs(next_reading(sensor).wrench - reaction.wrench) <= tolerance("ati_netcanoem")
        )


@pytest.mark.parametrize("kind", KINDS)
def test_a_silent_sensor_gives_no_reading_and_its_return_does(kind: str) -> None:
    wire = make_wire(kind, Reaction())
    with wire.device, make_sensor(wire.settings(), SYSTEM) as sensor:
        next_reading(sensor)
        wire.device.silent = True
        before_the_silence = 1000  # readings at most, in the buffers of wire and system
        while sensor.read(0.1) is not None:
            before_the_silence -= 1
            assert before_the_silence
        wire.device.silent = False
        assert next_reading(sensor).wrench[2] == pytest.approx(12.25, abs=0.1)


def test_a_sensor_that_does_not_answer_is_no_sensor() -> None:
    wire = make_wire("ati_netcanoem", Reaction())
    wire.device.silent = True
    with wire.device, pytest.raises(LinkError, match="base id 0x20"):
        make_sensor(wire.settings(), SYSTEM).connect()


def test_a_request_that_takes_too_long_to_write_is_one_missing_sample(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """pyserial's timeout leaves the port open; the library reports it as a broken connection."""
    wire = make_wire("robotiq_ft300 registers", Reaction())
    with wire.device, make_sensor(wire.settings(), SYSTEM) as made:
        sensor: Any = made
        next_reading(sensor)

        def too_late(_: bytes) -> int:
            raise serial.SerialTimeoutException("Write timeout")

        with monkeypatch.context() as stalled:
            stalled.setattr(sensor._client.socket, "write", too_late)
            dropped = sensor.dropped
            assert sensor.read(0.2) is None
            assert sensor.dropped == dropped + 1
        assert next_reading(sensor).wrench[2] == pytest.approx(12.25, abs=0.1)


@pytest.mark.parametrize("kind", ["robotous_rft", "robotiq_ft300"])
def test_close_ends_the_stream(kind: str) -> None:
    wire = make_wire(kind, Reaction())
    device: Any = wire.device
    with device:
        with make_sensor(wire.settings(), SYSTEM) as sensor:
            next_reading(sensor)
            assert device.streaming
        wait_for(lambda: not device.streaming, "the end of the stream")


def test_a_stream_left_running_does_not_disturb_the_start() -> None:
    wire = make_wire("robotiq_ft300", Reaction())
    device = wire.device
    assert isinstance(device, Ft300Device)
    with device:
        device.streaming = True
        device._due = time.monotonic()
        time.sleep(0.05)
        with make_sensor(wire.settings(), SYSTEM) as sensor:
            assert next_reading(sensor).wrench[2] == pytest.approx(12.25, abs=0.02)


def test_a_request_read_together_with_what_ends_the_stream_is_answered() -> None:
    device = Ft300Device(Reaction(), SYSTEM)
    request = struct.pack(">BBHHBH", 9, 16, 410, 1, 2, 0x0200)
    request += FramerRTU.compute_CRC(request).to_bytes(2, "big")
    with device, serial.Serial(device.path, timeout=10.0) as line:
        line.write(b"\xff" * 50 + request)
        assert line.read(8)[:6] == request[:6]


def test_a_write_that_times_out_is_one_attempt(monkeypatch: pytest.MonkeyPatch) -> None:
    wire, write = make_wire("robotiq_ft300", Reaction()), serial.Serial.write
    late = [serial.SerialTimeoutException("Write timeout")]

    def timed_out_once(line: serial.Serial, data: bytes) -> int | None:
        if late:
            raise late.pop()
        return write(line, data)

    monkeypatch.setattr(serial.Serial, "write", timed_out_once)
    with wire.device, make_sensor(wire.settings(), SYSTEM) as sensor:
        assert next_reading(sensor).wrench[2] == pytest.approx(12.25, abs=0.02)
    assert not late


def test_a_line_that_cannot_be_flushed_is_one_attempt(monkeypatch: pytest.MonkeyPatch) -> None:
    wire, flush = make_wire("robotiq_ft300", Reaction()), serial.Serial.flush
    failing = [termios.error(5, "Input/output error")]

    def failed_once(line: serial.Serial) -> None:
        if failing:
            raise failing.pop()
        flush(line)

    monkeypatch.setattr(serial.Serial, "flush", failed_once)
    with wire.device, make_sensor(wire.settings(), SYSTEM) as sensor:
        assert next_reading(sensor).wrench[2] == pytest.approx(12.25, abs=0.02)
    assert not failing


@pytest.mark.parametrize("kind", ["robotous_rft", "ati_netcanoem"])
def test_any_error_of_a_can_adapter_is_a_broken_link(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    wire = make_wire(kind, Reaction())

    def cut(*_: Any, **__: Any) -> None:
        raise IndexError("index out of range")  # slcan's, for a line that was cut short

    with wire.device, make_sensor(wire.settings(), SYSTEM) as sensor:
        next_reading(sensor)
        assert isinstance(sensor, CanSensor)
        monkeypatch.setattr(sensor._bus, "recv", cut)
        with pytest.raises(LinkError, match=f"{kind}.*index out of range"):
            next_reading(sensor)


@pytest.mark.parametrize("late", [0.6, 1.3])
def test_a_stream_that_is_slow_to_start_is_waited_for(
    late: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    device = Ft300Device(Reaction(), SYSTEM)
    wire, pass_bytes, begun = Wire(device, {"driver": "robotiq_ft300"}), device._pass_bytes, []

    def answer_late() -> None:
        if begun and time.monotonic() > begun[0] + late:
            pass_bytes()

    monkeypatch.setattr(device, "_pass_bytes", answer_late)
    with device:
        begun.append(time.monotonic())
        with make_sensor(wire.settings(), SYSTEM) as sensor:
            assert next_reading(sensor).wrench[2] == pytest.approx(12.25, abs=0.02)


def test_garbage_on_the_line_is_dropped_and_the_stream_goes_on() -> None:
    wire = make_wire("robotiq_ft300", Reaction())
    device = wire.device
    assert isinstance(device, Ft300Device)
    with device, make_sensor(wire.settings(), SYSTEM) as sensor:
        next_reading(sensor)
        half, broken = device.frame()[:9], bytearray(device.frame())
        broken[5] ^= 0x40
        for garbage in (b"\x20", b"\x20\x4e\x20", b"\x00" * 33, half, bytes(broken)):
            device.put(garbage)
            for _ in range(5):
                assert np.allclose(next_reading(sensor).wrench, Reaction().wrench, atol=0.01)
        until = time.monotonic() + PATIENCE
        while sensor.dropped < 33:  # behind what a busy machine has not read yet
            next_reading(sensor)
            assert time.monotonic() < until


def flood(wire: Wire, stop: threading.Event, rng: np.random.Generator) -> None:
    """Send frames of others, and pieces of samples under the sensor's own ids."""
    bus = can.Bus(interface="virtual", channel=wire.keys["channel"])
    ids = (0x01, 0x02, 0x01, 0x200, 0x201, 0x2A5, 0x7FF)
    while not stop.wait(0.002):
        data = rng.bytes(int(rng.integers(0, 8)))  # never whole
        bus.send(can.Message(arbitration_id=int(rng.choice(ids)), data=data, is_extended_id=False))
    bus.shutdown()


@pytest.mark.parametrize("kind", ["robotous_rft", "ati_netcanoem"])
def test_foreign_and_broken_frames_on_the_bus_never_make_a_sample(kind: str) -> None:
    wire, stop = make_wire(kind, Reaction()), threading.Event()
    noise = threading.Thread(target=flood, args=(wire, stop, np.random.default_rng(1)))
    with wire.device, make_sensor(wire.settings(), SYSTEM) as sensor:
        noise.start()
        try:
            for _ in range(60):
                found = next_reading(sensor).wrench
                assert np.all(np.abs(found - Reaction().wrench) <= tolerance(kind))
        finally:
            stop.set()
            noise.join()
        assert sensor.dropped > 0


def test_a_second_robotous_on_the_bus_is_another_pair_of_ids() -> None:
    wire = make_wire("robotous_rft", Reaction())
    assert isinstance(wire.device, RobotousNode)
    other = RobotousNode(Reaction((0.0,) * 6), wire.device._settings, SYSTEM, 0x65, (0x11, 0x12))
    second = wire.settings(command_id=0x65, reply_ids=(0x11, 0x12))
    with (
        wire.device,
        other,
        make_sensor(wire.settings(), SYSTEM) as a,
        make_sensor(second, SYSTEM) as b,
    ):
        assert next_reading(a).wrench[2] == pytest.approx(12.25, abs=0.02)
        assert next_reading(b).wrench == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("keys", "phrase"),
    [
        ({"driver": "robotous_rft", "reply_ids": (1, 1)}, "different"),
        ({"driver": "robotous_rft", "reply_ids": (1, 0x800)}, "11-bit"),
        ({"driver": "bota"}, "robotous_rft"),
        ({"driver": "ati_netcanoem", "base_id": 0x80}, "base_id"),
        ({"driver": "robotiq_ft300", "sign": 0}, "sign"),
        ({"driver": "robotiq_ft300", "channel": "can0"}, "channel"),
    ],
)
def test_settings_that_cannot_be_are_refused(keys: dict[str, Any], phrase: str) -> None:
    with pytest.raises(ValueError, match=phrase):
        settings_of(**keys)
