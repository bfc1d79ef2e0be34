"""Arming CiA 402 drives: what is read and heard while they are being enabled."""

from __future__ import annotations

from pathlib import Path

import can
import numpy as np
import pytest
from drive_arm import DriveArm, phases, served, settled
from patience import wait_for
from patient_drives import patient

from gapbridge.core.errors import ForeignCommandError, WriteError
from gapbridge.drivers.canopen.driver import CanopenDriver
from gapbridge.drivers.canopen.master import Master
from gapbridge.drivers.canopen.objects import ENABLE_OPERATION, Address
from gapbridge.drivers.canopen.power import (
    ABORT_CONNECTION,
    CONSUMER_HEARTBEAT,
    MODES_OF_OPERATION,
)
from gapbridge.drivers.canopen.state import states
from gapbridge.drivers.canopen.sync_set import SyncSet
from gapbridge.drivers.simulated.canopen.machine import Phase

INTERPOLATED_POSITION = 7  # a mode of operation
SWITCHED_ON = {"SWITCHED ON", "OPERATION ENABLED"}


def read_wrong_when_switched_on(
    monkeypatch: pytest.MonkeyPatch, driver: CanopenDriver, wrong: float, samples: int
) -> None:
    """Have joint 3 read off by ``wrong`` rad in the first samples of drives that are on."""
    exchange, left = driver.power._exchange, [samples]

    def exchanged() -> SyncSet | None:
        sample = exchange()
        if sample is None or not left[0] or not SWITCHED_ON & set(states(sample)):
            return sample
        left[0] -= 1
        counts = [dict(joint) for joint in sample.counts]
        counts[2]["Position actual value"] += int(wrong * driver.profile.counts_per_radian[2])
        return sample._replace(counts=tuple(counts))

    monkeypatch.setattr(driver.power, "_exchange", exchanged)


@pytest.mark.parametrize("samples", [1, 20])
def test_a_wrong_sample_while_the_drives_are_enabled_is_not_sent_as_the_target(
    arm: DriveArm, driver: CanopenDriver, monkeypatch: pytest.MonkeyPatch, samples: int
) -> None:
    state, send = settled(driver), driver.writer.send
    targets: list[np.ndarray] = []

    def sent(words: list[int], q: np.ndarray, *given: float) -> None:
        if ENABLE_OPERATION in words:
            targets.append(q)
        send(words, q, *given)

    read_wrong_when_switched_on(monkeypatch, driver, 0.3, samples)
    monkeypatch.setattr(driver.writer, "send", sent)
    with pytest.raises(WriteError, match=r"the arm moved 0\.300 rad when enabled"):
        driver.arm(state)
    assert Phase.ENABLED not in phases(arm)
    assert all(np.abs(q - state.actual_q).max() < 1e-3 for q in targets)


def test_joints_that_give_a_little_when_enabled_are_armed(
    arm: DriveArm, driver: CanopenDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_wrong_when_switched_on(monkeypatch, driver, 0.5 * driver.settings.arming_distance, 20)
    driver.arm(settled(driver))
    assert phases(arm) == {Phase.ENABLED}


def test_a_drive_that_is_enabled_in_another_mode_is_left_alone(
    arm: DriveArm, driver: CanopenDriver
) -> None:
    """It may jump to an old target at the change of mode; nothing is written to any drive."""
    node, drive = driver.profile.nodes[2], arm.server.drives[2]
    driver.master.write(node, MODES_OF_OPERATION, INTERPOLATED_POSITION)
    drive.axis.machine.phase = Phase.ENABLED
    with pytest.raises(WriteError, match=f"node {node}: found OPERATION ENABLED in mode 7"):
        driver.arm(settled(driver))
    assert drive.axis.mode == INTERPOLATED_POSITION
    assert drive.axis.machine.phase == Phase.ENABLED
    assert {other.axis.mode for other in arm.server.drives} == {0, INTERPOLATED_POSITION}


def test_a_mode_that_is_mapped_into_an_rpdo_is_ours(tmp_path: Path) -> None:
    """It is in the default RPDO2 of CiA 402: sent as it was, drives were enabled in any mode."""
    path = Path(patient("cia402", tmp_path))
    text = path.read_text(encoding="utf-8")
    mapped = text.replace("[Controlword, Target", "[Controlword, Modes of operation, Target")
    assert mapped != text
    path.write_text(mapped, encoding="utf-8")
    with served(str(path)) as arm, arm.driver() as driver:
        for node in driver.profile.nodes:
            driver.master.write(node, MODES_OF_OPERATION, INTERPOLATED_POSITION)
        driver.arm(settled(driver))
        assert {drive.axis.mode for drive in arm.server.drives} == {driver.profile.mode_number}
        driver.release()
        assert {drive.axis.mode for drive in arm.server.drives} == {INTERPOLATED_POSITION}


def test_release_gives_the_drives_back_what_they_watched(
    arm: DriveArm, driver: CanopenDriver
) -> None:
    """A PLC's heartbeat and an option code are put back; a watch of ours, left behind, is not."""
    nodes, ours = driver.profile.nodes, driver.profile.heartbeat.our_node
    for node, watched in zip(nodes, (0x7E00FA, ours << 16 | 250, 0), strict=False):
        driver.master.write(node, CONSUMER_HEARTBEAT, watched)
    driver.master.write(nodes[0], ABORT_CONNECTION, 2)
    driver.arm(settled(driver))
    drives = arm.server.drives
    assert {drive.number(0x1016, 1) >> 16 for drive in drives} == {ours}
    assert {drive.number(0x6007) for drive in drives} == {3}
    driver.release()
    assert [drive.number(0x1016, 1) for drive in drives[:3]] == [0x7E00FA, 0, 0]
    assert drives[0].number(0x6007) == 2


def test_another_master_while_the_drives_are_enabled_is_not_forgotten(
    arm: DriveArm, driver: CanopenDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It writes a Controlword by SDO, once."""
    prepare = driver.power.prepare
    frame = can.Message(arbitration_id=0x601, data=b"\x2b\x40\x60\0\6\0\0\0", is_extended_id=False)

    def commanded() -> None:
        prepare()
        with arm.other_bus() as bus:
            bus.send(frame)
        wait_for(lambda: driver.foreign is not None, "the other master's frame")

    monkeypatch.setattr(driver.power, "prepare", commanded)
    with pytest.raises(ForeignCommandError, match="another master sent SDO request to node 1"):
        driver.arm(settled(driver))
    assert Phase.ENABLED not in phases(arm)


def test_drives_that_cannot_be_told_to_stop_at_our_loss_are_warned_of(
    arm: DriveArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without 0x6007 they may hold, or go on, when our heartbeat ends."""
    read = Master.read_where_present

    def without_option(master: Master, node: int, address: Address) -> int | None:
        return None if (node, address) == (3, ABORT_CONNECTION) else read(master, node, address)

    with arm.driver() as driver:
        assert driver.arm(settled(driver)) == []
    monkeypatch.setattr(Master, "read_where_present", without_option)
    with arm.driver() as driver:
        (warned,) = driver.arm(settled(driver))
    assert "link.profile: found no 0x6007 in node 3" in str(warned)
    assert not warned.sure
