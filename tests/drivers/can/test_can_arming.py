"""Arming an arm on CAN: what is read and heard while its motors are being enabled."""

from __future__ import annotations

import struct
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
    goals = np.array(goals_of_joint_3(bus))
    assert goals.size, "the release holds the joints"
    assert np.abs(goals - state.actual_q[2]).max() < 2 * UNIT
    assert np.abs(before - served.controller.q).max() < 2 * UNIT


def test_joints_that_give_a_little_when_enabled_are_armed(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_wrong_when_enabled(monkeypatch, served, 0.5 * served.settings.arming_distance)
    served.driver.arm(next_state(served.driver))
    assert all(served.nodes.enabled)


def test_another_commander_while_the_motors_are_enabled_is_not_forgotten(
    served: Served, bus: can.BusABC, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = served.driver.writer.run

    def commanded(*given: Any) -> None:
        monkeypatch.undo()  # the release runs a sequence too
        bus.send(can.Message(arbitration_id=0x152, data=bytes(8), is_extended_id=False))
        run(*given)

    monkeypatch.setattr(served.driver.writer, "run", commanded)
    with pytest.raises(ForeignCommandError, match="another commander sent 0x152"):
        served.driver.arm(next_state(served.driver))
    with pytest.raises(WriteError, match=r"expected arm\(\) first"):
        served.driver.write_setpoint(setpoint_of(next_state(served.driver).actual_q))
