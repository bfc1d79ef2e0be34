"""A million ruined frames: no exception leaves the decoder, nothing wrong is believed."""

from __future__ import annotations

import time

import can
import numpy as np
import pytest
from canopen import Network

from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import InvalidStateError
from gapbridge.drivers.canopen.listening import BusListener, HeartbeatMonitor
from gapbridge.drivers.canopen.profile import CanopenProfile, read_profile
from gapbridge.drivers.canopen.settings import CanopenSettings
from gapbridge.drivers.canopen.state import StateBuilder
from gapbridge.drivers.canopen.sync_set import SyncCollector
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.state_check import SampleCheck

TOTAL = 1_000_000
Q = np.array([0.3, -1.2, 1.1, -0.4, 1.5, -2.0])
WELL = 0x0250  # Statusword: SWITCH ON DISABLED


def good_frames(profile: CanopenProfile) -> list[tuple[int, bytes]]:
    """Return one sample's frames, packed here by hand: little-endian, as the standard says."""
    frames = []
    for node, count in zip(profile.nodes, profile.counts(Q), strict=True):
        status = WELL.to_bytes(2, "little")
        position = int(count).to_bytes(4, "little", signed=True)
        frames.append((0x180 + node, status + position))
        frames.append((0x280 + node, bytes(4) + bytes(2) + b"\x08"))
    return frames


def ruined(
    frames: list[tuple[int, bytes]], random: np.random.Generator
) -> tuple[list[tuple[int, bytes]], bool]:
    """Return the frames with one fault, and whether a sample of them can be whole and true."""
    frames = list(frames)
    i = int(random.integers(len(frames)))
    cob_id, data = frames[i]
    match int(random.integers(7)):
        case 0:
            del frames[i]
            return frames, False
        case 1:
            frames.insert(int(random.integers(i + 1)), (cob_id, data))
            return frames, False
        case 2:
            frames[i] = (cob_id, data[: int(random.integers(len(data)))])
            return frames, False
        case 3:
            frames[i] = (cob_id, data + random.bytes(int(random.integers(1, 9 - len(data)))))
            return frames, False
        case 4:
            frames[i] = (int(random.integers(0x800)), random.bytes(int(random.integers(9))))
            return frames, False  # on the way it may hit one of ours: then that one is missing
        case 5:
            noise = (0x600, random.bytes(int(random.integers(9))))
            frames.insert(i, noise)
            return frames, True
    order = random.permutation(len(frames))
    return [frames[k] for k in order], True


@pytest.mark.slow
def test_a_million_frames_give_no_exception_and_no_wrong_sample() -> None:
    profile = read_profile(CanopenSettings.shipped / "cia402.yaml")
    collector = SyncCollector(profile, SYSTEM)
    builder, check = StateBuilder(profile), SampleCheck(builtin_arm("ur10e"))
    network = Network()
    for node in profile.nodes:
        network.add_node(node, profile.eds.dictionary(node))
    heartbeats = HeartbeatMonitor(network, profile, SYSTEM)
    listener = BusListener(network, CanopenSettings(profile="cia402"), profile, collector, SYSTEM)
    random, good = np.random.default_rng(4), good_frames(profile)
    count = taken = refused = 0
    begun = time.monotonic()
    while count < TOTAL:
        frames, true = ruined(good, random)
        collector.begin(0.0)
        for cob_id, data in frames:
            kind = int(random.integers(40))
            message = can.Message(
                arbitration_id=cob_id, data=data, is_extended_id=kind == 0,
                is_remote_frame=False, is_error_frame=kind == 1, check=False,
            )  # fmt: skip
            true = true and (kind > 1 or cob_id == 0x600)
            listener.on_message_received(message)
        count += len(frames)
        found = collector.wait(0.0)
        if found is None:
            refused += 1
            assert not true, collector.why()
            continue
        builder.reset()
        check.reset()
        try:
            state = builder.build(found, None, False)
            check.check(state)
        except InvalidStateError:
            refused += 1
            continue
        taken += 1
        assert np.abs(state.actual_q - Q).max() < 1e-6
    assert taken > 10_000
    assert refused > 10_000
    assert len(heartbeats.log) <= 64
    assert time.monotonic() - begun < 60.0


@pytest.mark.slow
def test_random_payloads_are_refused_or_are_what_their_bytes_say() -> None:
    profile = read_profile(CanopenSettings.shipped / "cia402.yaml")
    collector = SyncCollector(profile, SYSTEM)
    arm = builtin_arm("ur10e")
    builder, check = StateBuilder(profile), SampleCheck(arm)
    random = np.random.default_rng(5)
    identifiers = [cob_id for cob_id, _ in good_frames(profile)]
    for _ in range(20_000):
        collector.begin(0.0)
        sent: dict[int, bytes] = {}
        for cob_id in identifiers:
            sent[cob_id] = random.bytes(6 if cob_id < 0x200 else 7)
            collector.take(cob_id, sent[cob_id], 0.0)
        found = collector.wait(0.0)
        assert found is not None
        builder.reset()
        check.reset()
        try:
            state = builder.build(found, None, True)
            check.check(state)
        except InvalidStateError:
            continue
        raw = [int.from_bytes(sent[0x180 + n][2:], "little", signed=True) for n in profile.nodes]
        assert state.actual_q == pytest.approx(profile.angles(np.array(raw, float)))
        assert (np.abs(state.actual_q) < np.abs(arm.limits.upper) + 0.4).all()
