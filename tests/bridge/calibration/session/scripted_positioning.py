"""A session in memory: its plan, its joints, its instrument, and an operator with a script."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.calibration.instruments.instrument import (
    AnyInstrument,
    InstrumentContext,
    ReadRequest,
    Samples,
)
from gapbridge.bridge.calibration.instruments.typed import TypedCoordinates
from gapbridge.bridge.calibration.joints.joint_source import JointSample, JointSource
from gapbridge.bridge.calibration.session.journal import Entry
from gapbridge.bridge.calibration.session.measuring import Measuring
from gapbridge.bridge.calibration.session.positioning import Positioning
from gapbridge.bridge.calibration.session.prompt import COMMANDS, Prompt, SessionCommand
from gapbridge.bridge.calibration.session.session import Session
from gapbridge.bridge.cell.settings.calibration import CalibrationSettings
from gapbridge.bridge.cell.settings.instruments import TypedSettings
from gapbridge.core.calibration.plan import Expectation, Payload, Plan, PlannedPose

Array = NDArray[np.float64]


class ScriptEnded(Exception):
    """A question came for which the script has no answer."""


class ScriptedPrompt(Prompt):
    """Gives the answers of a script, in order."""

    def __init__(self, *answers: str) -> None:
        self._answers = iter(answers)
        self.shown: list[str] = []

    def say(self, text: str = "", style: str | None = None) -> None:
        self.shown.append(text)

    def ask_unless(self, question: str, poll: Callable[[], Any]) -> Any:
        self.shown.append(question)
        if (found := poll()) is not None:
            return found
        try:
            answer = next(self._answers)
        except StopIteration:
            raise ScriptEnded(question) from None
        if answer in COMMANDS:
            raise SessionCommand(answer)
        return answer

    @contextlib.contextmanager
    def waiting(self, text: str) -> Iterator[Callable[[str], None]]:
        yield lambda text: None


class ScriptedJoints(JointSource):
    """An arm that is where ``q`` (n,), rad, says; ``move`` is called for each move."""

    detects_rest = True

    def __init__(self, q: Array | None, move: Callable[[PlannedPose], None] | None = None) -> None:
        self.q, self._move = q, move
        self.can_move = move is not None

    def current_q(self) -> Array | None:
        return self.q

    def sample_at_rest(self, pose: PlannedPose) -> JointSample:
        assert self.q is not None
        return JointSample(self.q)

    def arrived(self, pose: PlannedPose) -> JointSample | None:
        there = self.q is not None and np.abs(self.q - pose.q).max() < 0.01
        return self.sample_at_rest(pose) if there else None

    def unmoved_since(self, sample: JointSample) -> bool:
        return self.q is not None and bool(np.abs(self.q - sample.q).max() < 2e-4)

    def move_to(self, pose: PlannedPose, via: Sequence[Array] = ()) -> None:
        assert self._move is not None
        self._move(pose)


class Tracker(TypedCoordinates):
    """A typed or automatic instrument; ``read`` is called for each reading."""

    def __init__(self, manual: bool, read: Callable[[], None] = lambda: None) -> None:
        super().__init__(TypedSettings(unit="m"), InstrumentContext(lambda question: ""))
        self.manual, self._read = manual, read
        self.count = 0  # of readings

    def read(self, request: ReadRequest) -> Samples:
        self.count += 1
        assert self.count < 20, "it is read again and again"
        self._read()
        return Samples(np.zeros((1, 3)))


class _Journal:
    entries: list[Entry] = []  # noqa: RUF012

    def add(self, kind: str, **fields: object) -> Entry:
        return {"kind": kind, "time": 1.0, **fields}


def session_of(stops: int) -> Session:
    """Return a session with one load, which is mounted; stop i is at 0.1 (i + 1) rad."""
    z = np.zeros(6)
    poses = tuple(PlannedPose(i, np.full(6, 0.1 * (i + 1)), 0, z) for i in range(stops))
    session = Session(cast("Any", _Journal()))
    session.plan = Plan(
        (Payload(1.0),), poses, Expectation((), (), z[:0], z[:0], 1.0, 1.0), (), 0.0, ()
    )
    session.mounted = 0
    return session


def measuring(
    session: Session, prompt: Prompt, joints: JointSource, instrument: AnyInstrument
) -> Measuring:
    """Return what measures the session, in a cell without obstacles."""
    positioning = Positioning(
        prompt, session, joints, instrument, lambda q: np.ones(len(q)), CalibrationSettings()
    )
    return Measuring(prompt, session, positioning, instrument, None, 2e-5, 1)
