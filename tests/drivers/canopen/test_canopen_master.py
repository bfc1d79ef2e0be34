"""The canopen library's own master drives our simulated drives: somebody else agrees with them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import canopen
import pytest
from canopen.profiles.p402 import BaseNode402
from drive_arm import DriveArm
from patience import PATIENCE, wait_for

from gapbridge.drivers.canopen.settings import CanopenSettings

EDS = str(CanopenSettings.shipped / "cia402.eds")
NODE = 3


class PatientNode(BaseNode402):  # type: ignore[misc]
    """The library's drive, whose answers a busy machine may hold up."""

    TIMEOUT_RESET_FAULT = TIMEOUT_SWITCH_OP_MODE = PATIENCE
    TIMEOUT_SWITCH_STATE_FINAL = TIMEOUT_SWITCH_STATE_SINGLE = PATIENCE
    TIMEOUT_CHECK_TPDO = PATIENCE


@contextmanager
def master(arm: DriveArm) -> Iterator[tuple[Any, BaseNode402]]:
    """Yield the library's network and its node for drive 3, set up as its documentation says."""
    network: Any = canopen.Network()
    network.NOTIFIER_CYCLE = 0.05
    network.connect(interface="virtual", channel=arm.settings.channel)
    node = PatientNode(NODE, EDS)
    network.add_node(node)
    node.sdo.RESPONSE_TIMEOUT = PATIENCE
    try:
        node.nmt.state = "PRE-OPERATIONAL"
        node.tpdo.read()
        node.rpdo.read()
        for pdo, objects in (
            (node.tpdo[1], (0x6041, 0x6061)),
            (node.tpdo[2], (0x6064,)),
            (node.rpdo[1], (0x6040, 0x607A)),
            (node.rpdo[2], (0x6060,)),
        ):
            pdo.clear()
            for index in objects:
                pdo.add_variable(index)
            pdo.enabled, pdo.trans_type = True, 1
            pdo.save()
        node.setup_402_state_machine()
        node.nmt.state = "OPERATIONAL"
        network.sync.start(0.01)
        yield network, node
    finally:
        network.sync.stop()
        network.disconnect()


def test_the_librarys_master_enables_moves_and_disables_a_drive(arm: DriveArm) -> None:
    with master(arm) as (_, node):
        axis = arm.server.drives[NODE - 1].axis
        wait_for(lambda: node.state == "SWITCH ON DISABLED", "a Statusword")
        here = node.sdo[0x6064].raw
        node.rpdo[1]["Target position"].raw = here
        node.rpdo[2]["Modes of operation"].raw = 8
        for pdo in (node.rpdo[1], node.rpdo[2]):
            pdo.start(0.01)
        wait_for(lambda: node.op_mode == "CYCLIC SYNCHRONOUS POSITION", "the mode")
        for state in ("READY TO SWITCH ON", "SWITCHED ON", "OPERATION ENABLED"):
            node.state = state
            assert node.state == state
        start, counts = arm.controller.q[NODE - 1], arm.server.profile.counts_per_radian[NODE - 1]
        for step in range(100):
            node.rpdo[1]["Target position"].raw = here + round(0.05 * counts * step / 99)
            time.sleep(0.01)
        wait_for(lambda: abs(arm.controller.q[NODE - 1] - start - 0.05) < 1e-5, "the plant's joint")
        assert all(not other.axis.holds for other in arm.server.drives if other.node != NODE)
        node.state = "SWITCHED ON"
        node.state = "SWITCH ON DISABLED"
        wait_for(lambda: not axis.holds, "the drive's end")


def test_the_librarys_master_resets_a_fault_that_an_emcy_reported(arm: DriveArm) -> None:
    with master(arm) as (_, node):
        arm.server.fail(NODE, 0x8611)
        wait_for(lambda: bool(node.emcy.active), "an EMCY")
        assert node.emcy.active[0].code == 0x8611
        wait_for(lambda: node.state == "FAULT", "the state FAULT")
        assert node.sdo[0x603F].raw == 0x8611
        node.rpdo[1].start(0.01)
        node.controlword = 0x00
        machine = arm.server.drives[NODE - 1].axis.machine
        wait_for(lambda: machine.word == 0x00, "the Controlword")  # a reset is its edge
        node.controlword = 0x80
        wait_for(lambda: node.state == "SWITCH ON DISABLED", "the reset")
        wait_for(lambda: not node.emcy.active, "the EMCY's end")


def test_heartbeats_and_boot_up_are_the_standards(arm: DriveArm) -> None:
    with master(arm) as (_, node):
        node.sdo[0x1017].raw = 50
        assert node.nmt.wait_for_heartbeat(PATIENCE) == "OPERATIONAL"
        arm.server.restart(NODE)
        node.nmt.wait_for_bootup(PATIENCE)
        assert node.nmt.state == "PRE-OPERATIONAL"


def test_an_nmt_reset_restarts_a_drive_with_the_eds_defaults(arm: DriveArm) -> None:
    with master(arm) as (_, node):
        assert node.sdo[0x1A00][0].raw == 2
        node.nmt.state = "RESET"
        wait_for(lambda: node.sdo[0x1A00][0].raw == 1, "the EDS defaults")


@pytest.mark.parametrize(
    ("index", "subindex", "value", "code"),
    [
        (0x1A00, 1, 0x60640020, 0x08000022),  # a PDO that is in use
        (0x6060, 0, 3, 0x06090030),  # profile velocity: not supported
        (0x6041, 0, 1, 0x06010002),  # read only
    ],
)
def test_what_a_drive_does_not_allow_is_aborted(
    arm: DriveArm, index: int, subindex: int, value: int, code: int
) -> None:
    with master(arm) as (_, node):
        found = node.sdo[index]
        with pytest.raises(canopen.SdoAbortedError) as caught:
            (found[subindex] if subindex else found).raw = value
        assert caught.value.code == code


def test_an_object_that_a_drive_has_not_is_aborted(arm: DriveArm) -> None:
    with master(arm) as (_, node), pytest.raises(canopen.SdoAbortedError) as caught:
        node.sdo.upload(0x2001, 0)
    assert caught.value.code == 0x06020000


def test_a_pdo_with_more_than_64_bits_is_aborted(arm: DriveArm) -> None:
    with master(arm) as (_, node):
        pdo = node.tpdo[3]
        pdo.read()
        pdo.clear()
        pdo.cob_id, pdo.enabled = 0x380 + NODE, True
        for index in (0x6064, 0x606C, 0x6041):
            pdo.add_variable(index)
        with pytest.raises(canopen.SdoAbortedError) as caught:
            pdo.save()
        assert caught.value.code == 0x06040042
