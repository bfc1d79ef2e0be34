"""Ruined answers into the decoder: no exception leaves it, nothing wrong is believed."""

from __future__ import annotations

import socket

import numpy as np
import pytest
from contract_modbus import INVENTED
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU
from pymodbus.pdu.register_message import ReadHoldingRegistersResponse

from gapbridge.core.arm import arm_from_dh
from gapbridge.core.errors import InvalidStateError, LinkError
from gapbridge.core.state import RobotState
from gapbridge.drivers.modbus.decode import Decoder, Sample
from gapbridge.drivers.modbus.map import compile_map
from gapbridge.drivers.modbus.profile import read_profile
from gapbridge.drivers.modbus.registers import wire_of
from gapbridge.drivers.modbus.settings import ModbusSettings
from gapbridge.drivers.modbus.transport import Transport
from gapbridge.drivers.simulated.modbus import image
from gapbridge.drivers.state_check import SampleCheck

Q = (0.3, -1.2, 1.1, -0.4, 2.8, -3.0)
GAP = 0.02  # s between two samples
FASTEST = 3.0  # rad/s
DH = {"a": 0.3, "alpha": 0.0, "d": 0.1, "offset": 0.0}
UR = read_profile(ModbusSettings.shipped / "ur.yaml")


def holding_of(profile) -> dict[int, int]:
    found = image.blank(profile)["holding"]
    values = {"position": Q, "velocity": (0.1,) * 6, "temperature": (25.0,) * 6,
              "force": (1.0, 2.0, 3.0), "moment": (0.1, 0.2, 0.3)}  # fmt: skip
    found.update(image.state_registers(profile, values)["holding"])
    spots = image.condition_registers(profile.status, frozenset())
    spots += image.clock_registers(profile, 12.0)
    found.update({address: value for table, address, value in spots if table == "holding"})
    return found


@pytest.mark.slow
def test_no_ruined_frame_is_taken_for_another_sample() -> None:
    """Bytes of a good answer, mutated: what comes through is the sample itself, or is refused.

    A flip inside the payload is what TCP's checksum guards; here it must at least be a sample that
    decodes to what its bytes say and passes the same plausibility checks.
    """
    compiled = compile_map(UR)
    block = compiled.fast[0]
    decoder = Decoder(UR, compiled)
    holding = holding_of(UR)
    good = [holding.get(a, 0) for a in range(block.first, block.first + block.count)]
    answer = ReadHoldingRegistersResponse(registers=good, dev_id=1, transaction_id=1)
    frame = FramerSocket(DecodePDU(False)).buildFrame(answer)
    assert np.abs(decoder.decode([wire_of(good)]).vectors["position"] - Q).max() <= 5e-4

    random = np.random.default_rng(20)
    total, taken, refused = 10_000, 0, 0
    with socket.create_server(("127.0.0.1", 0)) as listener:
        for data in mutations(frame, random, total):
            try:
                sample = decoder.decode([answered(data, block, listener)])
                check_after(np.array(Q), sample)
            except LinkError:
                refused += 1
                continue
            taken += 1
            away = np.abs(sample.vectors["position"] - Q)
            assert (away <= FASTEST * GAP + 0.011).all()
            assert all(np.isfinite(v).all() for v in sample.vectors.values())
    assert taken + refused == total
    assert refused > taken


def check_after(before: np.ndarray, sample: Sample) -> None:
    """Check a sample that comes GAP after the joints ``before``, as the driver's base does."""
    n, found = len(before), sample.vectors
    check = SampleCheck(arm_from_dh([DH] * n), FASTEST)
    still, force = np.zeros(n), np.zeros(6)
    check.check(RobotState(0.0, 0.0, before, still, before, force))
    q = found["position"]
    force = np.concatenate([found.get(name, np.zeros(3)) for name in ("force", "moment")])
    check.check(
        RobotState(
            GAP, GAP, q, found.get("velocity", still), found.get("target", q), force,
            joint_temperatures=found.get("temperature"),
            actual_current_as_torque=found.get("joint_torque"),
        )
    )  # fmt: skip


def answered(data: bytes, block, listener: socket.socket) -> bytes:
    """Return what the first request of a connection takes ``data`` for."""
    host, port = listener.getsockname()
    transport = Transport(ModbusSettings(driver="modbus", host=host, profile="ur"), port, 1)
    transport.open()
    try:
        with listener.accept()[0] as theirs:
            theirs.sendall(data)
            theirs.shutdown(socket.SHUT_WR)
            return transport.read(block)
    finally:
        transport.close()


def mutations(frame: bytes, random: np.random.Generator, count: int):
    """Yield frames with flipped bits and bytes, cut short, or grown."""
    size = len(frame)
    kinds = random.integers(0, 4, count)
    places = random.integers(0, size, (count, 3))
    values = random.integers(0, 256, (count, 3))
    heads = random.integers(0, 9, count)
    for kind, place, value, head in zip(kinds, places, values, heads, strict=True):
        data = bytearray(frame)
        if kind == 0:
            data[place[0]] ^= 1 << (value[0] % 8)
        elif kind == 1:
            data[head] = value[0]
        elif kind == 2:
            del data[place[0] :]
        else:
            for p, v in zip(place, value, strict=True):
                data[p] = v
        yield bytes(data)


def test_a_sample_whose_clock_moves_on_while_it_is_read_is_refused() -> None:
    profile = read_profile(INVENTED)
    compiled = compile_map(profile)
    decoder = Decoder(profile, compiled)
    holding = holding_of(profile)

    def blocks() -> list[bytes]:
        return [
            wire_of([holding.get(a, 0) for a in range(b.first, b.first + b.count)])
            for b in (*compiled.fast, *compiled.slow)
        ]

    clock = decoder.decode(blocks()).clock
    assert clock is not None
    holding[profile.clock.again + 1] += 1  # the low word of the clock behind the sample
    with pytest.raises(InvalidStateError, match="which is torn"):
        decoder.decode(blocks())


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", [*sorted(ModbusSettings.shipped.glob("*.yaml")), INVENTED], ids=lambda p: p.stem
)
def test_random_registers_are_refused_or_plausible(path) -> None:
    """Random and ruined samples of each profile."""
    profile = read_profile(path)
    compiled = compile_map(profile)
    decoder = Decoder(profile, compiled)
    blocks = (*compiled.fast, *compiled.slow)
    random = np.random.default_rng(8)
    rounds = 12_000
    widths = [b.count for b in blocks]
    before = np.zeros(profile.joints)
    held = decoded = 0
    for start in range(0, rounds, 4000):
        pool = random.integers(0, 0x10000, (4000, sum(widths)))
        pool[random.random(pool.shape) < 0.5] = 0
        for k, row in enumerate(pool.tolist()):
            parts, at = [], 0
            for block, width in zip(blocks, widths, strict=True):
                short = (start + k) % 97 == 0
                top = 1 if block.table in ("coil", "discrete") else 0xFFFF
                parts.append(wire_of([min(v, top) for v in row[at : at + width - short]]))
                at += width
            try:
                sample = decoder.decode(parts)
                decoded += 1
                check_after(before, sample)
            except InvalidStateError:
                continue
            held += 1
            assert np.abs(sample.vectors["position"]).max() <= FASTEST * GAP + 0.011
    assert held <= decoded < rounds
