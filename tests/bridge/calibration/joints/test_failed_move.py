"""A failed move reports its reason, and leaves a daemon that observes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from clock_by_hand import ByHand

from gapbridge.bridge.calibration.joints import link
from gapbridge.bridge.calibration.joints.link import DaemonRun, LinkedJoints
from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.ipc.events import Event, EventKind
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import Phase, slices_of
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import LinkError, RunError
from gapbridge.drivers.link_settings import DriverSettings

POSE = PlannedPose(0, np.ones(6), 0, np.zeros(6))
SLICES = slices_of(6)


def transition(before: State, after: State, cause: Cause, detail: str = "") -> Event:
    return {
        "kind": EventKind.TRANSITION, "from": before.name, "to": after.name, "cause": cause,
        "detail": detail,
    }  # fmt: skip


ARMED = transition(State.OBSERVING, State.ARMED, Cause.ARM)
WRITES = transition(State.ARMED, State.COMPENSATING, Cause.WRITING)
STOP = "the robot is not ready: protective stop"


class Clock(ByHand):
    """A clock by hand; at each sleep the next event happens."""

    def __init__(self) -> None:
        super().__init__()
        self.happens: list[Callable[[], None]] = []
        self.sleep = self._sleep

    def _sleep(self, seconds: float) -> None:
        self.now += seconds
        if self.happens:
            self.happens.pop(0)()


class FakeDaemon:
    """A daemon that observes an arm at rest at zero, and ``events`` of one that writes."""

    events: list[Event] = []  # noqa: RUF012
    reachable = True

    def __init__(
        self, settings: object, write: bool, clock: Clock, say: Callable[[str], None],
        log: Callable[[Event], None],
    ) -> None:  # fmt: skip
        self._clock, self._say, self._log = clock, say, log
        self.write, self.stopped = write, False
        self.phase = Phase.RUNNING
        width = max(s.stop for s in SLICES.values())
        self.memory = SimpleNamespace(
            slices=SLICES, width=width, n=6, ended=False,
            reader=lambda: SimpleNamespace(drain=lambda: self._row(width)),
        )  # fmt: skip
        if write:
            clock.happens += [lambda event=event: self._emit(event) for event in self.events]  # type: ignore[misc]

    @property
    def state(self) -> State:
        return State.OBSERVING if self.reachable or self.write else State.DISCONNECTED

    def _row(self, width: int) -> np.ndarray:
        row = np.zeros((1, width))
        row[0, [SLICES["timestamp"].start, SLICES["received"].start]] = self._clock.now
        return row

    def _emit(self, event: Event) -> None:
        if event["kind"] == EventKind.TRANSITION:
            tail = f": {event['detail']}" if event["detail"] else ""
            self._say(f"{event['from'].lower()} -> {event['to'].lower()} ({event['cause']}){tail}")
        else:
            self._say(event["detail"])
        self._log(event)

    def stop(self) -> None:
        self.stopped = True


class FakeRun(DaemonRun):
    """A run that goes on until it is stopped."""

    def _main(self, write: bool) -> None:
        pass

    def check(self) -> None:
        if self.daemon.stopped:  # type: ignore[attr-defined]
            raise LinkError("the link to the arm ended")


@pytest.fixture
def joints(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Return joints that observe the arm and may move it."""
    monkeypatch.setattr(link, "Daemon", FakeDaemon)
    monkeypatch.setattr(link, "DaemonRun", FakeRun)
    made: Any = object.__new__(LinkedJoints)
    made._clock, made._settle, made._speed, made._folder = Clock(), 0.5, 0.4, tmp_path
    made._settings = DaemonSettings.model_construct(link=DriverSettings())
    made.can_move, made._run = True, None
    made.open()
    return made


@pytest.mark.parametrize(
    ("events", "why"),
    [
        ([{"kind": EventKind.REFUSED, "what": "arm", "detail": STOP}], STOP),
        (
            [ARMED, transition(State.ARMED, State.OBSERVING, Cause.START_REFUSED, "too far")],
            "armed -> observing (start refused): too far",
        ),
        (  # within one cycle
            [ARMED, WRITES, transition(State.COMPENSATING, State.FAULT, Cause.WRITE_FAILED, "x")],
            "compensating -> fault (write failed): x",
        ),
        (
            [
                ARMED, WRITES,
                transition(State.COMPENSATING, State.HOLDING, Cause.OVERRUN, "26 of 500 missed"),
                transition(State.HOLDING, State.OBSERVING, Cause.RAMPED_OUT),
            ],
            "compensating -> holding (deadlines missed): 26 of 500 missed; "
            "holding -> observing (ramped out)",
        ),
        ([ARMED, WRITES, {"kind": EventKind.FAULT, "cause": "hang", "detail": "killed"}], "killed"),
    ],
)  # fmt: skip
def test_the_reason_of_a_failed_move_is_shown_at_once(
    joints: Any, monkeypatch: pytest.MonkeyPatch, events: list[Event], why: str
) -> None:
    monkeypatch.setattr(FakeDaemon, "events", events)
    begun = joints._clock.now
    with pytest.raises(RunError) as caught:
        joints.move_to(POSE)
    assert str(caught.value) == f"the move failed: {why}"
    assert joints._clock.now - begun < 0.5
    assert not joints._run.daemon.write
    np.testing.assert_array_equal(joints.current_q(), np.zeros(6))


def test_after_a_timeout_the_arm_is_observed(joints: Any) -> None:
    with pytest.raises(RunError, match="the arm did not arrive within"):
        joints.move_to(POSE)
    assert not joints._run.daemon.write
    np.testing.assert_array_equal(joints.current_q(), np.zeros(6))


def test_an_arm_that_cannot_be_observed_ends_the_session(
    joints: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused = {"kind": EventKind.REFUSED, "what": "arm", "detail": STOP}
    monkeypatch.setattr(FakeDaemon, "events", [refused])
    monkeypatch.setattr(FakeDaemon, "reachable", False)
    joints._run.daemon.write = True  # the first run still reports
    with pytest.raises(LinkError, match=f"{STOP}; the arm reports nothing"):
        joints.move_to(POSE)
