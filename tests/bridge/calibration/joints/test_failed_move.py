"""A failed move reports its reason."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from gapbridge.bridge.calibration.joints.link import LinkedJoints
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import RunError
from gapbridge.drivers.clock import SYSTEM

LINES = [
    "armed -> compensating (writing)",
    "compensating -> holding (deadlines missed): 26 of 500 cycles missed within 1 s",
    "holding -> observing (ramped out)",
]


class BrokenRun:
    """A run that writes, misses its deadlines, and observes."""

    def __init__(self) -> None:
        states = iter([State.ARMED, State.COMPENSATING, State.HOLDING, State.OBSERVING])
        self._said: list[str] = []
        run = self

        class Daemon(SimpleNamespace):
            @property
            def state(self) -> State:
                found = next(states)
                run._said = LINES[: {State.COMPENSATING: 1, State.OBSERVING: 3}.get(found, 0)]
                return found

        self.daemon = Daemon(memory=SimpleNamespace(ended=False))

    def check(self) -> None:
        pass

    def messages(self, since: int = 0) -> list[str]:
        return self._said[since:]


def test_the_reason_of_a_failed_move_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    joints = object.__new__(LinkedJoints)
    joints._clock = SYSTEM
    joints._run = BrokenRun()  # type: ignore[assignment]
    monkeypatch.setattr(joints, "current_q", lambda: None)
    pose = PlannedPose(0, np.zeros(6), 0, np.zeros(6))
    with pytest.raises(RunError) as caught:
        joints._wait_for_arrival(pose, 1.0)
    assert str(caught.value) == f"the move failed: {LINES[1]}; {LINES[2]}"
