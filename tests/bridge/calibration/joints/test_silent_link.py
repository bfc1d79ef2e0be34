"""Joints are readings only while the link reports them."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from clock_by_hand import ByHand
from numpy.typing import NDArray

from gapbridge.bridge.calibration.instruments.instrument import (
    InstrumentContext,
    ReadingError,
    ReadRequest,
)
from gapbridge.bridge.calibration.instruments.joint_only import PointContact
from gapbridge.bridge.calibration.joints.link import BUFFER_SPAN, DaemonRun, LinkedJoints
from gapbridge.bridge.calibration.session.measuring import capture
from gapbridge.bridge.cell.settings.instruments import PointSettings
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import slices_of
from gapbridge.core.calibration.plan import PlannedPose

Array = NDArray[np.float64]
HERE, THERE = np.zeros(6), np.full(6, 0.8)
SLICES = slices_of(6)


def pose_at(q: Array) -> PlannedPose:
    return PlannedPose(0, q, 0, np.zeros(6))


class Controller:
    """A controller at 500 Hz, whose cycles a daemon would read; ``reports`` makes them."""

    def __init__(self, clock: ByHand) -> None:
        self._clock, self._rows = clock, [np.empty((0, max(s.stop for s in SLICES.values())))]
        self.up_since, self.loop = 90000.0, 0  # s, number

    def reports(self, q: Array, seconds: float) -> None:
        """Let time pass in which the arm rests at ``q`` (n,), rad."""
        age = np.arange(0.0, seconds, 0.002)
        rows = np.zeros((len(age), self._rows[0].shape[1]))
        rows[:, SLICES["timestamp"].start] = self.up_since + age
        rows[:, SLICES["received"].start] = self._clock.now + age
        rows[:, SLICES["loop"].start] = self.loop
        rows[:, SLICES["actual_q"]] = q
        self._rows.append(rows)
        self._clock.sleep(seconds)
        self.up_since += seconds

    def drain(self) -> Array:
        rows, self._rows = np.vstack(self._rows), self._rows[:1]
        return rows


def observed(
    controller: Controller, clock: ByHand, settle: float = 0.5
) -> tuple[LinkedJoints, SimpleNamespace]:
    """Return joints that observe a controller, and their daemon."""
    daemon = SimpleNamespace(state=State.OBSERVING)
    run: Any = object.__new__(DaemonRun)
    run.slices, run.rows, run.daemon = SLICES, controller.drain(), daemon
    run.approach, run._last_moved, run._reader = np.zeros(6), None, controller
    run._thread, run._span = SimpleNamespace(is_alive=lambda: True), settle + BUFFER_SPAN
    run._rest, run.left, run.interrupted = None, False, False
    joints: Any = object.__new__(LinkedJoints)
    joints._run, joints._clock, joints._settle = run, clock, settle
    return joints, daemon


@pytest.fixture
def clock() -> ByHand:
    return ByHand()


@pytest.fixture
def controller(clock: ByHand) -> Controller:
    return Controller(clock)


def test_a_silent_link_gives_no_joints(clock: ByHand, controller: Controller) -> None:
    joints, _ = observed(controller, clock)
    controller.reports(HERE, 1.0)
    sample = joints.arrived(pose_at(HERE))
    assert sample is not None
    assert joints.unmoved_since(sample)
    clock.sleep(600.0)
    assert joints.arrived(pose_at(HERE)) is None
    assert joints.current_q() is None
    with pytest.raises(ReadingError, match="nothing for 600"):
        joints.unmoved_since(sample)
    with pytest.raises(ReadingError, match="nothing for 60"):
        joints.sample_at_rest(pose_at(HERE))


def test_a_contact_is_not_read_from_before_the_cut(clock: ByHand, controller: Controller) -> None:
    joints, _ = observed(controller, clock)
    controller.reports(HERE, 1.0)
    joints.sample_at_rest(pose_at(HERE))
    clock.sleep(1.0)
    touch = PointContact(PointSettings(kind="point"), InstrumentContext(lambda question: ""))
    with pytest.raises(ReadingError, match="has reported nothing"):
        capture(touch, joints, pose_at(THERE), None, ReadRequest())


def test_a_daemon_without_its_loop_gives_no_joints(clock: ByHand, controller: Controller) -> None:
    joints, daemon = observed(controller, clock)
    controller.reports(HERE, 1.0)
    daemon.state = State.DISCONNECTED
    assert joints.current_q() is None
    with pytest.raises(ReadingError, match="the link to the arm is down"):
        joints.sample_at_rest(pose_at(HERE))


@pytest.mark.parametrize("loop", [0, 1])
def test_after_a_restart_of_the_controller_the_arm_is_read_where_it_is(
    clock: ByHand, controller: Controller, loop: int
) -> None:
    joints, _ = observed(controller, clock)
    controller.reports(HERE, 30.0)
    joints.sample_at_rest(pose_at(HERE))
    controller.up_since, controller.loop = 40.0, loop
    controller.reports(THERE, 0.4)
    assert joints.arrived(pose_at(THERE)) is None  # at rest for less than the settling time
    controller.reports(THERE, 0.2)
    sample = joints.arrived(pose_at(THERE))
    assert sample is not None
    np.testing.assert_allclose(sample.q, THERE, atol=1e-9)


def test_the_arm_may_take_as_long_to_settle_as_the_cell_allows(
    clock: ByHand, controller: Controller
) -> None:
    joints, _ = observed(controller, clock, settle=60.0)
    for seconds, rests in ((59.0, False), (2.0, True), (20.0, True)):
        controller.reports(HERE, seconds)
        assert (joints.arrived(pose_at(HERE)) is not None) is rests


def test_rest_is_not_counted_from_before_a_gap(clock: ByHand, controller: Controller) -> None:
    joints, _ = observed(controller, clock)
    controller.reports(HERE, 10.0)
    controller.up_since += 2.0
    clock.sleep(2.0)
    controller.reports(HERE, 0.1)
    assert joints.arrived(pose_at(HERE)) is None
    controller.reports(HERE, 0.5)
    assert joints.arrived(pose_at(HERE)) is not None


@pytest.mark.parametrize(
    ("meanwhile", "unmoved"),
    [
        ([(HERE, 60.0)], True),
        ([(HERE, 3.0), (THERE, 0.3), (HERE, 60.0)], False),
        ([(HERE, 3.0), (HERE + 4e-4, 0.3), (HERE, 60.0)], False),
    ],
)
def test_an_arm_that_leaves_and_comes_back_while_a_reading_is_awaited_is_noticed(
    clock: ByHand, controller: Controller, meanwhile: list[tuple[Array, float]], unmoved: bool
) -> None:
    joints, _ = observed(controller, clock)
    controller.reports(HERE, 1.0)
    for phases, expected in ((list(meanwhile), unmoved), ([(HERE, 10.0)], True)):
        sample = joints.sample_at_rest(pose_at(HERE))
        await_reading(joints, controller, clock, phases)
        assert joints.unmoved_since(sample) is expected


def test_a_link_that_was_silent_while_a_reading_was_awaited_is_noticed(
    clock: ByHand, controller: Controller
) -> None:
    joints, _ = observed(controller, clock)
    controller.reports(HERE, 1.0)
    sample = joints.sample_at_rest(pose_at(HERE))
    clock.sleep(2.0)
    await_reading(joints, controller, clock, [(HERE, 60.0)])
    with pytest.raises(ReadingError, match="the link was interrupted"):
        joints.unmoved_since(sample)


def await_reading(
    joints: LinkedJoints, controller: Controller, clock: ByHand, phases: list[tuple[Array, float]]
) -> None:
    """Watch the arm until it has been through all phases (joints, s)."""
    over = threading.Event()

    def go_on(seconds: float) -> None:
        if phases:
            controller.reports(*phases.pop(0))
        else:
            over.set()

    joints._clock = SimpleNamespace(sleep=go_on, monotonic=clock.monotonic)  # type: ignore[assignment]
    with joints.watched():
        over.wait()
