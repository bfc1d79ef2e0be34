"""Sets of one SYNC: whole, each PDO once, none too short; whatever comes in whatever order."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gapbridge.drivers.canopen.objects import Address
from gapbridge.drivers.canopen.pdo import Entry, PdoLayout
from gapbridge.drivers.canopen.profile import read_profile
from gapbridge.drivers.canopen.settings import CanopenSettings
from gapbridge.drivers.canopen.state import StateBuilder, positions
from gapbridge.drivers.canopen.sync_set import SyncCollector, SyncSet
from gapbridge.drivers.clock import SYSTEM

PROFILE = read_profile(CanopenSettings.shipped / "cia402.yaml")
COB_IDS = [layout.cob_id(node) for node in PROFILE.nodes for layout in PROFILE.tpdo]
LENGTHS = {layout.cob_id(n): layout.length for n in PROFILE.nodes for layout in PROFILE.tpdo}


def frame_of(cob_id: int, value: int) -> bytes:
    return bytes([value]) * LENGTHS[cob_id]


@given(
    st.lists(st.tuples(st.sampled_from([*COB_IDS, 0x701, 0x7FF]), st.integers(-1, 1)), max_size=30)
)
def test_a_set_is_given_only_when_each_pdo_came_once_and_whole(
    frames: list[tuple[int, int]],
) -> None:
    collector = SyncCollector(PROFILE, SYSTEM)
    collector.begin(0.0)
    for cob_id, more in frames:
        collector.take(cob_id, bytes(LENGTHS.get(cob_id, 3) + more), 0.0)
    ours = [(cob_id, more) for cob_id, more in frames if cob_id in LENGTHS]
    # what comes after the set was whole is reported as a stray, not as a part of it
    first = ours[: len(COB_IDS)]
    whole = sorted(cob_id for cob_id, _ in first) == sorted(COB_IDS) and not any(
        m for _, m in first
    )
    found = collector.wait(time.monotonic())
    assert (found is not None) == whole
    assert bool(collector.stray) == (whole and len(ours) > len(COB_IDS))


@given(st.permutations(COB_IDS))
def test_the_order_of_a_sets_frames_does_not_matter(order: list[int]) -> None:
    collector = SyncCollector(PROFILE, SYSTEM)
    collector.begin(0.0)
    for cob_id in order:
        collector.take(cob_id, frame_of(cob_id, cob_id & 7), 1.0)
    found = collector.wait(time.monotonic())
    assert found is not None
    wanted = [int.from_bytes(bytes([node]) * 4, "little") for node in PROFILE.nodes]
    assert [c["Position actual value"] for c in found.counts] == wanted
    assert positions(PROFILE, found) == pytest.approx(PROFILE.angles(np.array(wanted)))


def test_a_frame_before_any_sync_or_after_the_set_is_a_stray() -> None:
    collector = SyncCollector(PROFILE, SYSTEM)
    collector.take(COB_IDS[0], frame_of(COB_IDS[0], 0), 0.0)
    assert collector.stray == "TPDO1 of node 1"
    collector.clear_stray()
    collector.begin(0.0)
    for cob_id in COB_IDS:
        collector.take(cob_id, frame_of(cob_id, 0), 0.0)
    assert collector.wait(time.monotonic()) is not None
    collector.take(COB_IDS[1], frame_of(COB_IDS[1], 0), 0.0)
    assert collector.stray == "TPDO2 of node 1"


def test_what_a_torn_set_lacked_may_come_late_once() -> None:
    collector = SyncCollector(PROFILE, SYSTEM)
    collector.begin(0.0)
    for cob_id in COB_IDS[1:]:
        collector.take(cob_id, frame_of(cob_id, 0), 0.0)
    assert collector.wait(time.monotonic()) is None
    assert collector.why() == "found 11 of 12 TPDOs, without TPDO1 of node 1"
    assert collector.awaits_late
    collector.take(COB_IDS[0], frame_of(COB_IDS[0], 0), 0.0)
    assert not collector.awaits_late
    assert not collector.stray
    collector.take(COB_IDS[0], frame_of(COB_IDS[0], 0), 0.0)
    assert collector.stray == "TPDO1 of node 1"


entries = st.lists(
    st.tuples(st.sampled_from([1, 5, 8, 16, 24, 32]), st.booleans()), min_size=1, max_size=4
).filter(lambda rows: sum(bits for bits, _ in rows) <= 64)


@given(entries, st.data())
def test_counts_survive_their_way_through_a_pdo(
    rows: list[tuple[int, bool]], data: st.DataObject
) -> None:
    members = tuple(
        Entry(f"object {i}", Address(0x2000 + i, 0), bits, signed)
        for i, (bits, signed) in enumerate(rows)
    )
    layout = PdoLayout(1, members, True)
    counts = {m.name: data.draw(st.integers(m.low, m.high)) for m in members}
    assert layout.decode(layout.encode(counts)) == counts
    worst = members[0]
    with pytest.raises(ValueError, match="object 0"):
        layout.encode({**counts, worst.name: worst.high + 1})
    with pytest.raises(ValueError, match="bytes"):
        layout.decode(layout.encode(counts) + b"\0")


def test_a_layout_agrees_with_the_canopen_library() -> None:
    import canopen

    node = canopen.RemoteNode(1, str(CanopenSettings.shipped / "cia402.eds"))
    for layout in PROFILE.tpdo:
        pdo = node.tpdo[layout.number]
        pdo.clear()
        for entry in layout.entries:
            pdo.add_variable(entry.address.index, entry.address.subindex, entry.bits)
        counts = {e.name: (e.low + 3 if e.signed else e.high - 5) for e in layout.entries}
        for variable, entry in zip(pdo.map, layout.entries, strict=True):
            variable.raw = counts[entry.name]
        assert bytes(pdo.data) == layout.encode(counts)


@pytest.mark.parametrize("name", ["lwa4p", "cia402"])
def test_speeds_are_the_drives_own_or_come_from_positions(name: str) -> None:
    profile = read_profile(CanopenSettings.shipped / f"{name}.yaml")
    builder = StateBuilder(profile)
    speed = np.array([0.5, -0.5, 0.2, 0.0, -0.3, 1.0])
    reported = np.rint(speed * profile.counts_per_radian)
    for step in range(8):
        synced = 0.01 * step + (0.0005 if step % 2 else 0.0)  # a SYNC that is not punctual
        counts = profile.counts(speed * synced)
        rows = [
            {"Statusword": 0x0250, "Position actual value": int(q), "Velocity actual value": int(v),
             "Torque actual value": 0}
            for q, v in zip(counts, reported, strict=True)
        ]  # fmt: skip
        state = builder.build(SyncSet(tuple(rows), synced, synced + 0.001), None, False)
        builder.remember(state)
    assert state.actual_qd == pytest.approx(speed, abs=1e-3)
    assert state.timestamp == synced


def test_layouts_compare_by_what_they_hold() -> None:
    layout = PROFILE.tpdo[0]
    assert replace(layout, number=2).cob_id(1) == layout.cob_id(1) + 0x100
