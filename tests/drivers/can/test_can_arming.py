"""Arming an arm on CAN: what is read and heard while its motors are being enabled."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from typing import Any

import can
import numpy as np
import pytest
from can_arm import UNIT, Served, next_state, other_bus, served_arm, setpoint_of

from gapbridge.core.errors import ForeignCommandError, WriteError
from gapbridge.drivers.can.assembler import Sample


@pytest.fixture
def served() -> Iterator[Served]:
    with served_arm() as found:
        found.driver.connect()
        yield found


@pytest.fixture
def bus(served: Served) -> Iterator[can.BusABC]:
    found = other_bus(served.settings)
    yield found
    found.shutdown()


def goals_of_joint_3(bus: can.BusABC) -> list[float]:
    """Return what joint 3 was commanded to (rad) in the frames on the bus so far."""
    found = []
    while (frame := bus.recv(0.0)) is not None:
        if frame.arbitration_id == 0x156:
            found.append(struct.unpack(">ii", bytes(frame.data))[0] * UNIT)
    return found


def read_wrong_when_enabled(monkeypatch: pytest.MonkeyPatch, served: Served, wrong: float) -> None:
    """Have the driver read joint 3 off by ``wrong`` rad in all samples of enabled motors."""
    reader, known = served.driver.reader, served.driver.reader.listen

    def listen(seconds: float) -> Sample | None:
        sample = known(seconds)
        if sample is None or not reader.enabled:
            return sample
        position = sample.position.copy()
        position[2] += wrong
        return sample._replace(position=position)

    monkeypatch.setattr(reader, "listen", listen)


def test_a_wrong_sample_while_the_motors_are_enabled_is_not_sent_as_the_goal(
    served: Served, bus: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    state, before = next_state(served.driver), np.array(served.controller.q)
    read_wrong_when_enabled(monkeypatch, served, 0.1)
    with pytest.raises(WriteError, match=r"the arm moved 0\.100 rad when enabled"):
        served.driver.arm(state)
    assert not goals_of_joint_3(bus)
    assert np.abs(before - served.controller.q).max() < 2 * UNIT


def test_an_arm_that_was_moved_while_its_motors_were_enabled_is_not_pulled_back(
    served: Served, bus: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver, state = served.driver, next_state(served.driver)
    moved = state.actual_q.copy()
    moved[2] += 0.1
    served.controller.move_own(tuple(moved))  # by a person's hand
    monkeypatch.setattr(driver, "_reached", lambda _: np.abs(moved - driver._q).max() < 1e-3)
    with pytest.raises(WriteError, match=r"the arm moved 0\.\d+ rad when enabled"):
        driver.arm(state)
    next_state(driver)
    assert not goals_of_joint_3(bus)
    assert np.abs(moved - served.controller.q).max() < 1e-3


def test_an_arm_whose_joints_are_not_heard_any_more_is_not_held_where_it_stood(
    served: Served, bus: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver, state = served.driver, next_state(served.driver)
    served.nodes.withheld.add(0x2A5)  # of joints 1 and 2: no sample is complete
    begun = time.monotonic()
    monkeypatch.setattr(driver, "_reached", lambda _: time.monotonic() - begun > 1.5)
    with pytest.raises(WriteError, match=r"found joints \d\.\d+ s old, expected at most 1 s"):
        driver.arm(state)
    assert not goals_of_joint_3(bus)


def test_an_arm_that_stands_where_it_was_is_held_by_a_refused_arming(
    served: Served, bus: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = next_state(served.driver)
    monkeypatch.setattr(served.driver, "_reached", lambda goal: goal == "enabled")
    with pytest.raises(WriteError, match=r"hold: not ready after 2 s"):
        served.driver.arm(state)
    goals = goals_of_joint_3(bus)
    assert np.abs(np.array(goals) - state.actual_q[2]).max() < 2 * UNIT


def test_joints_that_give_a_little_when_enabled_are_armed(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_wrong_when_enabled(monkeypatch, served, 0.5 * served.settings.arming_distance)
    served.driver.arm(next_state(served.driver))
    assert all(served.nodes.enabled)


def test_another_commander_while_the_motors_are_enabled_is_not_forgotten(
    served: Served, bus: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, sequences = served.driver.writer.run, []

    def commanded(*given: Any) -> None:
        sequences.append(given[0])
        bus.send(can.Message(arbitration_id=0x152, data=bytes(8), is_extended_id=False))
        run(*given)

    monkeypatch.setattr(served.driver.writer, "run", commanded)
    with pytest.raises(ForeignCommandError, match="another commander sent 0x152"):
        served.driver.arm(next_state(served.driver))
    assert sequences == [served.driver.profile.enable], "no release: its hold would be a goal"
    with pytest.raises(WriteError, match=r"expected arm\(\) first"):
        served.driver.write_setpoint(setpoint_of(next_state(served.driver).actual_q))
