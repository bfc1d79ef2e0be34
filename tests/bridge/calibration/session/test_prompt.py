"""Questions at a terminal: what was typed before them answers none, and Enter means Enter."""

from __future__ import annotations

import os
import pty
import sys
import threading
import time
from collections.abc import Iterator

import pytest

from gapbridge.bridge.calibration.session.prompt import Prompt, SessionCommand


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Yield the end of a terminal at which a person types."""
    ours, theirs = pty.openpty()
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        yield ours
    os.close(ours)


def typed_later(keyboard: int, *lines: str) -> None:
    """Type lines, each some time after the one before."""

    def run() -> None:
        for line in lines:
            time.sleep(0.4)
            os.write(keyboard, f"{line}\n".encode())

    threading.Thread(target=run, daemon=True).start()


def test_what_was_typed_before_a_question_does_not_answer_it(
    keyboard: int, capsys: pytest.CaptureFixture[str]
) -> None:
    os.write(keyboard, b"yes\n1.0 2.0 3.0\nhalf a li")
    time.sleep(0.1)
    typed_later(keyboard, "no")
    assert not Prompt().confirm("Write the cell?")
    assert "discarded input typed before the question: yes ⏎ 1.0 2.0 3.0" in capsys.readouterr().out


def test_enter_is_enter_and_nothing_else(keyboard: int, capsys: pytest.CaptureFixture[str]) -> None:
    typed_later(keyboard, "no", "wait", "")
    Prompt().enter("Enter when it is mounted")
    said = capsys.readouterr().out
    assert "found 'no', expected Enter" in said
    assert "found 'wait', expected Enter" in said


def test_words_of_the_session_work_where_enter_is_asked(keyboard: int) -> None:
    typed_later(keyboard, "undo")
    with pytest.raises(SessionCommand, match="undo"):
        Prompt().enter("Enter when it is mounted")
