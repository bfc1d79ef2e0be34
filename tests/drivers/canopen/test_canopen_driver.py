"""The driver against simulated drives: what is read, what is written, and what goes wrong."""

from __future__ import annotations

import time
from contextlib import suppress

import can
import numpy as np
import pytest
from drive_arm import DriveArm, follow, phases, read_on, served, setpoint, settled
from patience import PATIENCE, wait_for, wait_for_error
from ports import free_port

from gapbridge.core.errors import (
    ForeignCommandError,
    InputError,
    InvalidStateError,
    LinkError,
    StaleStateError,
    WriteError,
)
from gapbridge.drivers.canopen.driver import CanopenDriver
from gapbridge.drivers.simulated.canopen.machine import Phase

BOTH_MODES = pytest.mark.parametrize("arm", ["cia402", "lwa4p"], indirect=True)


def node_of(arm: DriveArm, joint: int) -> int:
    return arm.server.profile.nodes[joint]


# -- reading and writing --------------------------------------------------------------------------


@BOTH_MODES
def test_setpoints_in_both_modes_bring_the_plant_there_and_release_leaves_it(
    arm: DriveArm,
) -> None:
    with arm.driver() as driver:
        before = [drive.number(0x6060) for drive in arm.server.drives]
        driver.arm(settled(driver))
        assert phases(arm) == {Phase.ENABLED}
        goal = np.array(arm.controller.q) + 0.05 * np.array([1, -1, 1, -1, 1, -1])
        follow(driver, goal, arm.controller)
        assert settled(driver).robot_mode == 7
        driver.release()
        assert phases(arm) == {Phase.SWITCH_ON_DISABLED}
        assert np.abs(goal - arm.controller.q).max() < 2e-4
        assert [drive.number(0x6060) for drive in arm.server.drives] == before
        assert all(drive.number(0x1016, 1) == 0 for drive in arm.server.drives)


@BOTH_MODES
def test_connecting_reading_and_closing_enable_nothing_and_move_nothing(arm: DriveArm) -> None:
    start = arm.controller.q
    with arm.driver() as driver:
        for _ in range(10):
            settled(driver)
        assert phases(arm) == {Phase.SWITCH_ON_DISABLED}
    assert arm.controller.q == start
    wait_for(
        lambda: all(drive.nmt.state == "PRE-OPERATIONAL" for drive in arm.server.drives),
        "the drives' answer to NMT",
    )  # fmt: skip


@BOTH_MODES
def test_arming_holds_the_arm_where_it_stands(arm: DriveArm) -> None:
    with arm.driver() as driver:
        start = np.array(arm.controller.q)
        driver.arm(settled(driver))
        for _ in range(20):
            settled(driver)
        assert np.abs(start - arm.controller.q).max() < 2e-5


def test_it_can_be_armed_released_and_armed_again(arm: DriveArm, driver: CanopenDriver) -> None:
    for _ in range(3):
        driver.arm(settled(driver))
        assert phases(arm) == {Phase.ENABLED}
        driver.release()
        assert phases(arm) == {Phase.SWITCH_ON_DISABLED}


def test_torque_is_in_newton_metres_with_the_joints_sign(
    arm: DriveArm, driver: CanopenDriver
) -> None:
    wanted = np.mean([arm.controller.joint_torque for _ in range(1)], axis=0)
    found = np.mean([settled(driver).actual_current_as_torque for _ in range(20)], axis=0)
    assert found == pytest.approx(wanted, abs=1.5)
    assert np.abs(found).max() > 5.0


def test_setpoints_take_effect_together_at_the_next_sync(arm: DriveArm) -> None:
    with arm.driver(rate=10.0) as driver:  # so slow that its SYNC may be late on a busy machine
        driver.arm(settled(driver))
        state = settled(driver)
        goal = state.actual_q + 0.01
        driver.write_setpoint(setpoint(goal, state))
        time.sleep(0.05)
        assert np.abs(goal - arm.controller.q).min() > 0.009, "it counted without a SYNC"
        settled(driver)
        wait_for(lambda: bool(np.abs(goal - arm.controller.q).max() < 1e-4), "the setpoint")


def test_a_setpoint_whose_sync_comes_too_late_never_takes_effect(
    arm: DriveArm, driver: CanopenDriver
) -> None:
    driver.arm(settled(driver))
    state = settled(driver)
    hold = np.array(arm.controller.q)
    driver.write_setpoint(setpoint(hold + 0.02, state))
    time.sleep(0.1)  # the process stands still, for less than the drives wait for its heartbeat
    for _ in range(5):
        target = settled(driver).target_q
    assert np.abs(hold - arm.controller.q).max() < 1e-5
    assert np.abs(hold - target).max() < 1e-5
    assert driver.take_lapsed(), "the loop must go on from what is in force"
    assert not driver.take_lapsed(), "once"
    driver.write_setpoint(setpoint(hold + 0.001, settled(driver)))
    settled(driver)
    assert not driver.take_lapsed()


class _Failing:
    """A bus whose n-th frame and ``broken`` after it do not get out."""

    def __init__(self, bus: can.BusABC, after: int, broken: int) -> None:
        self._bus, self.left, self.broken = bus, after, broken

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        self.left -= 1
        if self.left < 0 and self.broken > 0:
            self.broken -= 1
            raise can.CanOperationError("no buffer space")
        self._bus.send(message, timeout)

    def __getattr__(self, name: str) -> object:
        return getattr(self._bus, name)


@pytest.mark.parametrize("broken", [1, 6])
def test_a_part_of_a_setpoint_never_takes_effect(
    arm: DriveArm, driver: CanopenDriver, broken: int
) -> None:
    driver.arm(settled(driver))
    state = settled(driver)
    hold = np.array(arm.controller.q)
    network = driver.master.network
    real, network.bus = network.bus, _Failing(network.bus, 3, broken)
    with pytest.raises(WriteError, match=r"no buffer space.*3 of 6 out"):
        driver.write_setpoint(setpoint(hold + 0.02, state))
    for _ in range(6):
        with suppress(LinkError):
            driver.read_state()
    network.bus = real
    for _ in range(5):
        settled(driver)
    assert np.abs(hold - arm.controller.q).max() < 1e-5
    assert driver.writer.reverted > 0
    driver.write_setpoint(setpoint(hold + 0.001, settled(driver)))


def test_a_setpoint_that_is_not_finite_or_leaves_the_counts_is_refused(
    arm: DriveArm, driver: CanopenDriver
) -> None:
    driver.arm(settled(driver))
    state = settled(driver)
    for wrong in (np.full(6, np.nan), np.full(6, 1e6), np.zeros(5)):
        with pytest.raises(WriteError):
            driver.write_setpoint(setpoint(wrong, state))
    assert np.abs(state.actual_q - arm.controller.q).max() < 1e-4


# -- samples --------------------------------------------------------------------------------------


def test_a_set_without_one_drives_pdo_is_torn(arm: DriveArm, driver: CanopenDriver) -> None:
    settled(driver)
    arm.server.mute(node_of(arm, 3))
    words = "10 of 12 TPDOs, without TPDO1 of node 4"
    assert wait_for_error(driver.read_state, InvalidStateError, words)
    arm.server.unmute()
    settled(driver)


@pytest.mark.realtime(limit=0.02)
@pytest.mark.parametrize(("delay", "count"), [(0.009, 4), (0.045, 1)])
def test_a_pdo_of_the_sync_before_is_never_taken_for_this_ones(
    arm: DriveArm, driver: CanopenDriver, delay: float, count: int
) -> None:
    torn = 0
    for _ in range(5):
        settled(driver)
        arm.server.delay_tpdos(node_of(arm, 2), delay, count)
        for _ in range(6):
            try:
                state = driver.read_state()
            except (InvalidStateError, StaleStateError):
                torn += 1
            else:
                assert np.abs(state.actual_q - arm.controller.q).max() < 1e-3
    assert torn


def test_a_pdo_that_no_sync_asked_for_is_reported(arm: DriveArm, driver: CanopenDriver) -> None:
    settled(driver)
    text, until = "", time.monotonic() + PATIENCE
    with arm.other_bus() as bus:
        while "came without a SYNC" not in text and time.monotonic() < until:
            bus.send(can.Message(arbitration_id=0x181, data=bytes(6), is_extended_id=False))
            time.sleep(0.02)  # on a busy machine it may come between a SYNC and its answer
            try:
                driver.read_state()
            except LinkError as error:
                text = str(error)
    assert "TPDO1 of node 1 came without a SYNC" in text
    settled(driver)


@pytest.mark.parametrize("extended", [True, False])
def test_frames_of_others_are_no_samples(
    arm: DriveArm, driver: CanopenDriver, extended: bool
) -> None:
    with arm.other_bus() as bus:
        for identifier in (0x181, 0x205) if extended else (0x1F0, 0x190):
            bus.send(can.Message(arbitration_id=identifier, data=bytes(8), is_extended_id=extended))
    state = settled(driver)
    assert np.abs(state.actual_q - arm.controller.q).max() < 1e-3
    assert driver.foreign is None


# -- losses and faults ----------------------------------------------------------------------------


def test_a_lost_node_is_stale_and_named(arm: DriveArm, driver: CanopenDriver) -> None:
    settled(driver)
    arm.server.mute(node_of(arm, 4))
    assert wait_for_error(driver.read_state, StaleStateError, "node 5")


def test_a_missing_heartbeat_is_stale_though_pdos_come() -> None:
    with served("cia402", is_patient=False) as arm, arm.driver() as driver:
        settled(driver)
        arm.server.drives[1].nmt.stop_heartbeat()
        assert wait_for_error(
            driver.read_state, StaleStateError, r"node 2: no heartbeat for 0\.3 s"
        )


def test_a_drive_that_restarts_is_a_lost_link(arm: DriveArm, driver: CanopenDriver) -> None:
    driver.arm(settled(driver))
    arm.server.restart(node_of(arm, 0))
    with pytest.raises(LinkError, match="node 1: has restarted"):
        read_on(driver)
    driver.close()
    assert Phase.ENABLED not in phases(arm)


def test_an_emergency_is_a_fault_that_stops_writing_and_is_named(
    arm: DriveArm, driver: CanopenDriver
) -> None:
    driver.arm(settled(driver))
    arm.server.fail(node_of(arm, 2), 0x2310)
    wait_for(lambda: settled(driver).safety_mode == 9, "safety_mode fault")
    state = settled(driver)
    with pytest.raises(WriteError, match=r"node 3: found FAULT.*EMCY 0x2310"):
        driver.write_setpoint(setpoint(state.actual_q, state))
    driver.release()
    with pytest.raises(WriteError, match=r"found FAULT.*clear_faults"):
        driver.arm(settled(driver))
    assert Phase.ENABLED not in phases(arm)


def test_faults_are_reset_where_the_cell_says_so(arm: DriveArm) -> None:
    with arm.driver(clear_faults=True) as driver:
        arm.server.fail(node_of(arm, 2), 0x2310)
        wait_for(lambda: Phase.FAULT in phases(arm), "a fault")
        state = settled(driver)
        assert state.safety_mode == 1, "the loop refuses to arm a robot that says it is in fault"
        driver.arm(state)
        assert settled(driver).safety_mode == 1
        assert phases(arm) == {Phase.ENABLED}


def test_a_drive_that_cannot_be_enabled_leaves_none_enabled(arm: DriveArm) -> None:
    with arm.driver(arming_time=0.3, clear_faults=True) as driver:
        arm.controller.emergency_stop()
        state = settled(driver)
        with pytest.raises(WriteError, match="does not follow setpoints"):
            driver.arm(state)
        assert Phase.ENABLED not in phases(arm)


@pytest.mark.parametrize("refused", ["write", "read"])
def test_a_drive_that_refuses_an_object_while_arming_leaves_all_as_they_were(
    refused: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The drives are switched on, and an object that we do not command is in their RPDO."""
    with served("lwa4p") as arm, arm.driver() as driver:
        node, master = node_of(arm, 3), driver.master
        state = settled(driver)
        for drive in arm.server.drives:
            drive.axis.machine.phase = Phase.SWITCHED_ON
        known = getattr(master, refused)

        def refuse(asked: int, *given: object) -> object:
            if asked == node:
                raise LinkError(f"node {asked} refuses")
            return known(asked, *given)

        with monkeypatch.context() as patch:
            patch.setattr(master, refused, refuse)
            with pytest.raises(WriteError, match=f"node {node} refuses"):
                driver.arm(state)
        assert Phase.ENABLED not in phases(arm)
        if refused == "read":  # nothing was written before it
            assert {drive.axis.mode for drive in arm.server.drives} == {0}


def test_drives_stop_by_themselves_when_we_fall_silent(
    arm: DriveArm, driver: CanopenDriver
) -> None:
    driver.arm(settled(driver))
    state = settled(driver)
    driver.write_setpoint(setpoint(state.actual_q + 0.001, state))
    settled(driver)  # from here on silent, as a process that hangs, or was killed
    wait_for(lambda: Phase.ENABLED not in phases(arm), "the drives' own stop")
    wait_for(lambda: not any(arm.controller.qd), "the end of the motion")
    rest = arm.controller.q
    time.sleep(0.1)
    assert arm.controller.q == rest


def test_a_bus_that_dies_is_a_lost_link() -> None:
    with served("cia402", interface="socketcand", port=free_port()) as arm, arm.driver() as driver:
        settled(driver)
        arm.thread.stop()
        with pytest.raises(LinkError):
            read_on(driver)
        driver.close()
        arm.thread.start()
        with arm.driver() as again:
            settled(again)


# -- another master -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("identifier", "data", "phrase"),
    [
        (0x080, b"", "SYNC"),
        (0x000, b"\x01\x05", "NMT command"),
        (0x204, bytes(6), "RPDO1 of node 4"),
        (0x603, b"\x40\x41\x60\x00\x00\x00\x00\x00", "SDO request to node 3"),
        (0x77F, b"\x05", "heartbeat with our node id"),
    ],
)
def test_another_master_is_noticed_and_writing_refused(
    arm: DriveArm, driver: CanopenDriver, identifier: int, data: bytes, phrase: str
) -> None:
    driver.arm(settled(driver))
    with arm.other_bus() as bus:
        bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        wait_for(lambda: driver.foreign is not None, "the other master's frame")
    state = settled(driver)
    with pytest.raises(ForeignCommandError, match=f"another master sent {phrase}"):
        driver.write_setpoint(setpoint(state.actual_q, state))
    driver.release()


def test_arming_waits_until_another_master_has_been_quiet(arm: DriveArm) -> None:
    with arm.driver(foreign_quiet=0.4) as driver, arm.other_bus() as bus:
        time.sleep(0.4)
        bus.send(can.Message(arbitration_id=0x204, data=bytes(6), is_extended_id=False))
        wait_for(lambda: driver.foreign is not None, "the other master's frame")
        with pytest.raises(ForeignCommandError, match="found two masters"):
            driver.arm(settled(driver))
        assert Phase.ENABLED not in phases(arm)
        time.sleep(0.4)
        driver.arm(settled(driver))


def test_a_bus_with_a_master_on_it_is_not_joined(arm: DriveArm) -> None:
    with arm.other_bus() as bus:
        task = bus.send_periodic(can.Message(arbitration_id=0x80, is_extended_id=False), 0.01)
        with pytest.raises(LinkError, match="another master sent SYNC"):
            arm.driver().connect()
        task.stop()


# -- connecting -----------------------------------------------------------------------------------


def test_a_node_that_is_not_there_is_named() -> None:
    with served("cia402") as arm:
        arm.server.mute(6)
        with pytest.raises(LinkError, match="node 6 does not answer"):
            arm.driver(sdo_timeout=0.1).connect()


def test_a_bus_that_is_not_served_is_reported_soon() -> None:
    arm = DriveArm("cia402", interface="socketcand", port=free_port())
    with pytest.raises(LinkError, match="cannot be reached"):
        arm.driver().connect()


def test_units_that_cannot_be_are_refused_when_connecting(arm: DriveArm) -> None:
    driver = arm.driver()
    driver.profile.counts_per_radian[2] *= 20.0
    with pytest.raises(LinkError, match=r"node 3: found software position limits .*joint 3"):
        driver.connect()


def test_a_device_that_is_no_drive_is_refused(arm: DriveArm) -> None:
    arm.server.drives[0].data_store[0x1000] = {0: (401).to_bytes(4, "little")}
    with pytest.raises(LinkError, match="node 1: found device profile 401, expected 402"):
        arm.driver().connect()


def test_a_mode_that_a_drive_lacks_is_refused(arm: DriveArm) -> None:
    arm.server.drives[5].data_store[0x6502] = {0: (1).to_bytes(4, "little")}
    with pytest.raises(LinkError, match="node 6: found supported drive modes 0x1"):
        arm.driver().connect()


def test_fixed_pdos_that_are_others_are_refused(arm: DriveArm) -> None:
    driver = arm.driver()
    object.__setattr__(driver.profile.file, "pdo_setup", "check")
    with pytest.raises(LinkError, match=r"node 1: TPDO1 maps 0x6041, expected 0x6041, 0x6064"):
        driver.connect()


@pytest.mark.parametrize(("rate", "phrase"), [(500.0, "at most 250"), (93.0, "whole ms")])
def test_a_rate_that_the_drives_cannot_keep_is_refused(rate: float, phrase: str) -> None:
    with pytest.raises(InputError, match=rf"link\.rate: found {rate:g}.*{phrase}"):
        DriveArm("cia402").driver(rate=rate)


def test_closing_an_armed_driver_switches_the_drives_off(arm: DriveArm) -> None:
    driver = arm.driver()
    driver.connect()
    driver.arm(settled(driver))
    driver.close()
    driver.close()
    assert phases(arm) == {Phase.SWITCH_ON_DISABLED}
    with pytest.raises(LinkError):
        driver.read_state()
