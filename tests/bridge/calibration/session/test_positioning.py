"""The arm moves only while the operator's last answer permits it, and is measured at rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scripted_positioning import (
    ScriptedJoints,
    ScriptedPrompt,
    ScriptEnded,
    Tracker,
    measuring,
    session_of,
)

from gapbridge.bridge.calibration.instruments.files import ReadingsFile
from gapbridge.bridge.calibration.instruments.instrument import InstrumentContext, ReadingError
from gapbridge.bridge.calibration.instruments.joint_only import PointContact
from gapbridge.bridge.calibration.joints.joint_source import JointSample
from gapbridge.bridge.cell.settings.instruments import FileSettings, PointSettings
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import LinkError, RunError


class Arm(ScriptedJoints):
    """An arm whose first move ends with a protective stop."""

    def __init__(self) -> None:
        super().__init__(np.zeros(6), self._go)
        self.moves: list[int] = []

    def _go(self, pose: PlannedPose) -> None:
        self.moves.append(pose.number)
        if len(self.moves) == 1:
            raise RunError("the move failed: protective stop")
        self.q = pose.q


@pytest.mark.parametrize("answer", ["skip", "undo", "moved", "slipped", "back"])
def test_after_a_failed_move_a_command_is_no_yes(answer: str) -> None:
    arm, prompt = Arm(), ScriptedPrompt("yes", answer)
    with pytest.raises(ScriptEnded, match="The arm will be moved"):
        measuring(session_of(3), prompt, arm, Tracker(manual=False)).run()
    assert arm.moves == [0]


def test_after_a_failed_move_yes_continues_the_load() -> None:
    arm, session = Arm(), session_of(3)
    measuring(session, ScriptedPrompt("yes", "yes"), arm, Tracker(manual=False)).run()
    assert arm.moves == [0, 0, 1, 2]
    assert [r.stop for r in session.accepted] == [0, 1, 2]


def test_after_a_failed_move_no_leaves_the_arm_to_the_operator() -> None:
    arm, prompt = Arm(), ScriptedPrompt("yes", "no")
    with pytest.raises(ScriptEnded, match="measured as soon as it rests there"):
        measuring(session_of(3), prompt, arm, Tracker(manual=False)).run()
    assert arm.moves == [0]


def test_an_arm_that_cannot_be_observed_after_a_move_ends_the_session() -> None:
    def lose(pose: PlannedPose) -> None:
        raise LinkError("the arm did not arrive; the arm reports nothing")

    arm, prompt = ScriptedJoints(np.zeros(6), lose), ScriptedPrompt("yes", "yes")
    with pytest.raises(LinkError, match="reports nothing"):
        measuring(session_of(1), prompt, arm, Tracker(manual=False)).run()


def test_a_typed_reading_of_an_arm_that_settled_late_is_typed_once_more() -> None:
    arm, session = ScriptedJoints(np.full(6, 0.1)), session_of(1)

    def settle() -> None:
        arm.q = np.full(6, 0.1004)

    instrument, prompt = Tracker(manual=True, read=settle), ScriptedPrompt()
    measuring(session, prompt, arm, instrument).run()
    assert prompt.shown.count("! the arm moved while it was measured") == 1
    np.testing.assert_array_equal(session.accepted[0].q, arm.q)


def test_a_reading_is_typed_again_where_the_link_was_silent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arm, session, silences = ScriptedJoints(np.full(6, 0.1)), session_of(1), ["nothing for 3 s"]

    def unmoved(sample: JointSample) -> bool:
        if silences:
            arm.q = np.full(6, 0.1005)
            raise ReadingError(silences.pop())
        return bool((sample.q == arm.q).all())

    monkeypatch.setattr(arm, "unmoved_since", unmoved)
    measuring(session, ScriptedPrompt(), arm, Tracker(manual=True)).run()
    np.testing.assert_array_equal(session.accepted[0].q, arm.q)


@pytest.mark.parametrize("stop", ["", "1,"])
def test_a_row_that_was_written_while_the_arm_moved_is_not_read_again(
    tmp_path: Path, stop: str
) -> None:
    arm, session, file = ScriptedJoints(np.full(6, 0.1)), session_of(1), tmp_path / "readings.csv"
    title = "stop," if stop else ""
    file.write_text(f"{title}x,y,z\n{stop}1000,2000,300\n", encoding="utf-8")
    settings = FileSettings(kind="file", file=file, unit="mm", timeout=0.01)
    instrument = ReadingsFile(settings, InstrumentContext(lambda question: ""))

    class Measured(ScriptedPrompt):
        def enter(self, question: str) -> None:  # to try again: the tracker measures once more
            with file.open("a", encoding="utf-8") as rows:
                rows.write(f"{stop}1000.2,2000,300\n")

    def unmoved(sample: JointSample) -> bool:
        before, arm.q = sample.q, np.full(6, 0.1004)
        return bool((before == arm.q).all())

    arm.unmoved_since = unmoved  # type: ignore[method-assign]
    measuring(session, Measured(), arm, instrument).run()
    np.testing.assert_allclose(session.accepted[0].value, [1.0002, 2.0, 0.3])
    np.testing.assert_array_equal(session.accepted[0].q, arm.q)


def test_enter_does_not_measure_an_arm_that_reports_nothing() -> None:
    prompt = ScriptedPrompt("")
    with pytest.raises(ScriptEnded, match="measured as soon as it rests there"):
        measuring(session_of(1), prompt, ScriptedJoints(None), Tracker(manual=True)).run()
    assert "! the controller reports no joints now: is the link to the arm up?" in prompt.shown


def test_a_touch_that_is_confirmed_twice_counts_once() -> None:
    arm, session = ScriptedJoints(np.full(6, 0.1)), session_of(2)

    class Operator(ScriptedPrompt):
        def enter(self, question: str) -> None:  # to try again
            arm.q = np.full(6, 0.2)

    prompt = Operator()
    touch = PointContact(PointSettings(kind="point"), InstrumentContext(lambda question: ""))
    measuring(session, prompt, arm, touch).run()
    assert [r.q[0] for r in session.accepted] == [0.1, 0.2]
    assert "! found the joints of stop 1, expected another orientation" in prompt.shown


def test_undo_takes_back_what_was_done_last_a_skip_too() -> None:
    session, prompt = session_of(4), ScriptedPrompt("skip", "skip", "undo", "undo", "undo")
    with pytest.raises(ScriptEnded):  # at stop 2, after stop 1 was measured twice
        measuring(
            session, prompt, ScriptedJoints(np.full(6, 0.1)), Tracker(manual=False)
        ).run()  # fmt: skip
    done = [line.strip() for line in prompt.shown if "after all" in line or "discarded" in line]
    assert done == [
        "to be measured after all: stop 3", "to be measured after all: stop 2",
        "discarded the reading of stop 1",
    ]  # fmt: skip
    assert (session.remaining, session.undone) == (3, 1)
