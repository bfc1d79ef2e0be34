import struct
import threading
import time
from contextlib import suppress

import can
import numpy as np
import pytest
from can_arm import MODEL, UNIT, next_state, other_bus, served_arm, setpoint_of
from patience import PATIENCE, wait_for, wait_for_error

from gapbridge.core.errors import InvalidStateError, LinkError, StaleStateError, WriteError
from gapbridge.drivers.can.driver import CanDriver
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.profile_file import ProfileError


@pytest.fixture
def served():
    with served_arm() as found:
        found.driver.connect()
        yield found


def armed(served):
    served.driver.arm(next_state(served.driver))
    return next_state(served.driver)


def state_when(served, condition):
    """Return the first sample of which the condition holds."""
    latest = time.monotonic() + PATIENCE
    while not condition(state := next_state(served.driver)):
        assert time.monotonic() < latest, state
    return state


def for_three_samples(driver):
    for _ in range(3):
        driver.read_state()


def read(driver, count):
    """Read samples; a busy machine tears one now and then."""
    for _ in range(count):
        with suppress(InvalidStateError):
            driver.read_state()


class Listener:
    """Everything that goes over the bus from now on, but what the arm itself sends."""

    def __init__(self, settings):
        self.bus = other_bus(settings)

    def commands(self):
        found, end = [], time.monotonic() + 0.2
        while time.monotonic() < end:
            frame = self.bus.recv(0.01)
            if frame and (
                frame.arbitration_id in range(0x150, 0x160) or frame.arbitration_id == 0x471
            ):
                found.append((frame.arbitration_id, bytes(frame.data)))
        return found


class Breaking:
    """A bus whose sends fail when it is asked to."""

    def __init__(self, bus, fails):
        self._bus, self._fails = bus, fails
        self.sent = []

    def send(self, frame, timeout=None):
        if self._fails(frame, len(self.sent)):
            raise can.CanOperationError("no room in the transmit queue")
        self.sent.append((frame.arbitration_id, bytes(frame.data)))
        self._bus.send(frame, timeout)


def test_connecting_and_reading_send_no_frame():
    with served_arm() as served:
        listener = Listener(served.settings)
        served.driver.connect()
        for _ in range(20):
            next_state(served.driver)
        assert listener.bus.recv(0.05) is not None  # the arm's own frames are heard
        served.driver.close()
        end = time.monotonic() + 0.3
        while time.monotonic() < end:
            frame = listener.bus.recv(0.0)
            assert frame is None or frame.arbitration_id >= 0x251


def test_arming_enables_where_the_arm_stands_and_moves_nothing(served):
    before = np.array(served.controller.q)
    state = armed(served)
    time.sleep(0.1)
    assert np.abs(before - served.controller.q).max() < 2 * UNIT
    assert (state.robot_mode, state.safety_mode) == (7, 1)
    assert all(served.nodes.enabled)


def test_another_commander_on_the_bus_keeps_us_from_arming(served):
    bus = other_bus(served.settings)
    frame = can.Message(arbitration_id=0x155, data=bytes(8), is_extended_id=False)
    task = bus.send_periodic(frame, 0.01)
    driver, quiet = served.driver, 1.0  # s; on a busy machine the last one may be long ago
    driver.settings = served.settings.model_copy(update={"foreign_quiet": quiet})
    state = state_when(served, lambda _: driver.reader.foreign is not None)
    with pytest.raises(WriteError, match=r"another commander sent 0x155 .* two masters"):
        driver.arm(state)
    assert not any(served.nodes.enabled)
    task.stop()
    task.thread.join()  # it may have a frame to send yet
    state_when(served, lambda _: time.monotonic() - driver.reader.foreign.seen > quiet)
    armed(served)
    bus.shutdown()


def test_another_commander_while_we_write_ends_our_writing(served):
    state = armed(served)
    served.driver.write_setpoint(setpoint_of(state.actual_q))
    bus = other_bus(served.settings)
    bus.send(can.Message(arbitration_id=0x152, data=bytes(8), is_extended_id=False))
    state = state_when(served, lambda _: served.driver.reader.foreign is not None)
    with pytest.raises(WriteError, match="another commander sent 0x152"):
        served.driver.write_setpoint(setpoint_of(state.actual_q))
    bus.shutdown()


@pytest.mark.parametrize("at", [1, 2, 3])
def test_half_a_setpoint_is_taken_back(served, at):
    q = armed(served).actual_q
    served.driver.write_setpoint(setpoint_of(q))
    first = served.driver.writer._last
    failed = []

    def once(frame, sent):
        if sent == at and not failed:
            failed.append(frame)
            return True
        return False

    breaking = Breaking(served.driver.reader.bus, once)
    served.driver.writer.use(breaking)
    with pytest.raises(WriteError, match=rf"{at} of 4 frames out; the setpoint before was sent"):
        served.driver.write_setpoint(setpoint_of(q + 0.001))
    assert breaking.sent[at:] == [
        (key[0], data) for key, data in first
    ]  # whole, and last on the wire
    assert served.driver.writer.reverted == 1
    wait_for(
        lambda: served.controller.target_q == pytest.approx(q, abs=UNIT), "the setpoint before"
    )


def test_where_the_setpoint_before_does_not_go_out_either_the_arm_is_stopped(served):
    q = armed(served).actual_q
    served.driver.write_setpoint(setpoint_of(q))

    def only_the_stop(frame, sent):
        return sent >= 2 and frame.arbitration_id != 0x150

    breaking = Breaking(served.driver.reader.bus, only_the_stop)
    served.driver.writer.use(breaking)
    with pytest.raises(WriteError, match="the stop sequence was sent"):
        served.driver.write_setpoint(setpoint_of(q + 0.001))
    assert breaking.sent[-1] == (0x150, b"\x01" + bytes(7))
    assert state_when(served, lambda state: state.safety_mode != 1).safety_mode == 7


def test_a_first_frame_that_fails_leaves_nothing_to_take_back(served):
    q = armed(served).actual_q
    breaking = Breaking(served.driver.reader.bus, lambda *_: True)
    served.driver.writer.use(breaking)
    with pytest.raises(WriteError, match="0 of 4 frames out; nothing of it was sent"):
        served.driver.write_setpoint(setpoint_of(q))
    assert breaking.sent == []


@pytest.mark.parametrize("bad", [np.nan, np.inf, 7.0])
def test_a_setpoint_that_no_frame_can_carry_sends_nothing(served, bad):
    q = armed(served).actual_q
    breaking = Breaking(served.driver.reader.bus, lambda *_: False)
    served.driver.writer.use(breaking)
    wrong = q.copy()
    wrong[5] = bad  # the last frame's: those before must not be out
    with pytest.raises(WriteError):
        served.driver.write_setpoint(setpoint_of(wrong))
    assert breaking.sent == []


def test_no_identifier_leaves_that_the_profile_does_not_list(served):
    with pytest.raises(WriteError, match="0x2a5 is not among the profile's sends"):
        served.driver.writer._send((0x2A5, False), bytes(8))
    with pytest.raises(WriteError, match="0x155 is not among"):
        served.driver.writer._send((0x155, True), bytes(8))


def test_everything_we_send_is_in_the_allow_list(served):
    listener = Listener(served.settings)
    state = armed(served)
    for _ in range(5):
        served.driver.write_setpoint(setpoint_of(state.actual_q))
        next_state(served.driver)
    served.driver.release()
    ids = {identifier for identifier, _ in listener.commands()}
    assert ids == {0x151, 0x155, 0x156, 0x157, 0x471}


def test_a_motor_that_loses_its_power_while_we_write_is_reported(served):
    armed(served)
    served.nodes.enabled[2] = False
    state = state_when(served, lambda state: state.robot_mode != 7)
    assert state.robot_mode == 5  # as a mode that is taken away


def test_a_mode_taken_away_at_the_arm_is_reported_only_while_we_write(served):
    assert next_state(served.driver).robot_mode == 7  # standby, but we only read
    armed(served)
    served.nodes.control_mode = 2  # somebody drags the arm
    assert state_when(served, lambda state: state.robot_mode != 7).robot_mode == 5


def test_the_stop_button_is_an_emergency_stop_and_keeps_us_from_arming(served):
    served.controller.emergency_stop()
    state = state_when(served, lambda state: state.safety_mode != 1)
    assert state.safety_mode == 7
    assert state.safety_status_bits != 1
    with pytest.raises(WriteError, match=r"emergency_stop: ArmStatus.arm_status is 1"):
        served.driver.arm(state)


def test_a_stop_that_comes_and_goes_while_frames_make_no_sample_is_reported_once(served):
    driver, controller = served.driver, served.controller

    def read_until_stopped(stopped):
        until = time.monotonic() + PATIENCE
        while bool(driver.reader.stop_reason(writing=False)[0]) != stopped:
            assert time.monotonic() < until
            with suppress(InvalidStateError, StaleStateError):
                driver.read_state()

    next_state(driver)
    served.nodes.withheld.add(0x2A6)
    controller.emergency_stop()
    read_until_stopped(True)
    controller.release_emergency_stop()
    controller.unlock()
    read_until_stopped(False)
    served.nodes.withheld.clear()
    assert next_state(driver).safety_mode == 7
    assert next_state(driver).safety_mode == 1


def test_status_that_falls_silent_while_joints_go_on_is_stale(served):
    served.nodes.withheld.add(0x2A1)
    next_state(served.driver)
    assert wait_for_error(served.driver.read_state, StaleStateError, "no ArmStatus for 1 s")


def test_joints_that_stand_still_though_commanded_away_are_stale(served):
    state = armed(served)
    served.controller.frozen = True  # the same joints again and again
    goal = state.actual_q + 0.04
    served.driver.write_setpoint(setpoint_of(goal))
    assert wait_for_error(served.driver.read_state, StaleStateError, "joints have not changed")


def test_a_lost_frame_costs_its_sample_and_is_reported(served):
    next_state(served.driver)
    served.nodes.withheld.add(0x2A6)
    with pytest.raises((InvalidStateError, StaleStateError)):
        for_three_samples(served.driver)
    served.nodes.withheld.clear()
    state = next_state(served.driver)
    assert state.actual_q == pytest.approx(served.controller.q, abs=UNIT)


def test_an_arm_that_is_not_on_the_bus_is_one_line_with_what_was_missed():
    settings = CanSettings(profile="piper", interface="virtual", channel="nobody")
    driver = CanDriver(settings, MODEL, clock=SYSTEM)
    with pytest.raises(LinkError, match=r"virtual nobody: AgileX PiPER: never heard JointFeedback"):
        driver.connect()


def test_an_arm_of_another_number_of_joints_is_refused_before_the_bus_is_opened():
    settings = CanSettings(profile="openarm", interface="virtual", channel="nobody")
    with pytest.raises(ProfileError, match=r"found 7 joints in OpenArm .*, expected 6"):
        CanDriver(settings, MODEL, clock=SYSTEM)


@pytest.mark.realtime(limit=0.1)
def test_old_samples_are_left_for_the_newest(served):
    next_state(served.driver)
    time.sleep(0.3)
    state = next_state(served.driver)
    assert time.monotonic() - state.received < 0.2  # not the 0.3 s that it has waited
    assert next_state(served.driver).received - state.received < 0.2


@pytest.mark.realtime(limit=0.06)
def test_a_backlog_full_of_others_frames_does_not_keep_old_samples_alive(served):
    stranger = other_bus(served.settings)
    ended = threading.Event()

    def chatter():
        while not ended.wait(0.001):
            stranger.send(can.Message(arbitration_id=0x2A2, data=bytes(8), is_extended_id=False))

    thread = threading.Thread(target=chatter)
    thread.start()
    try:
        served.controller.move_own(tuple(q + 0.3 for q in served.controller.q))
        for _ in range(10):  # slower than the arm sends
            time.sleep(0.05)
            before = np.array(served.controller.q)
            state = next_state(served.driver)
            assert (
                np.abs(state.actual_q - before).max() < 0.06
            )  # 120 ms at 0.5 rad/s; a backlog is half a second long
    finally:
        ended.set()
        thread.join()
        stranger.shutdown()


def test_velocity_torque_and_temperature_are_the_plants(served):
    state = next_state(served.driver)
    assert state.actual_current_as_torque == pytest.approx(
        np.clip(served.controller.joint_torque, -38.7, 38.7),  # what the currents' 16 bits hold
        abs=2.0,
    )
    assert state.joint_temperatures == pytest.approx(served.controller.temperatures, abs=0.6)


def test_frames_on_the_wire_are_those_of_the_manual(served):
    listener = Listener(served.settings)
    armed(served)
    q = np.radians([10.0005, -20.0, 30.0, -40.0, 50.0, -60.0])
    served.driver.writer.write(q)
    assert [frame for frame in listener.commands() if frame[0] != 0x471][-4:] == [
        (0x151, bytes([1, 1, 100, 0, 0, 0, 0, 0])),
        (0x155, struct.pack(">ii", 10000, -20000)),
        (0x156, struct.pack(">ii", 30000, -40000)),
        (0x157, struct.pack(">ii", 50000, -60000)),
    ]
