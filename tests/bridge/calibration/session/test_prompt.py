"""Questions at a terminal: early input is discarded, and Enter alone continues."""

from __future__ import annotations

import os
import pty
import sys
from collections.abc import Callable, Iterator

import pytest

from gapbridge.bridge.calibration.session import prompt
from gapbridge.bridge.calibration.session.prompt import Prompt, SessionCommand


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """Yield the end of a terminal at which a person types."""
    ours, theirs = pty.openpty()
    with os.fdopen(theirs) as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        yield ours
    os.close(ours)


@pytest.fixture
def types(keyboard: int, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Return who types lines one by one, each when a question waits for it."""
    flush, line = prompt._InputLines.flush, prompt._InputLines.line
    left: list[str] = []
    asked = [False]

    def flushed(self: prompt._InputLines) -> str:
        asked[0] = True
        return flush(self)

    def waits(self: prompt._InputLines, seconds: float) -> str | None:
        if asked[0] and left:
            os.write(keyboard, f"{left.pop(0)}\n".encode())
        asked[0] = False
        return line(self, seconds)

    monkeypatch.setattr(prompt._InputLines, "flush", flushed)
    monkeypatch.setattr(prompt._InputLines, "line", waits)
    return lambda *lines: left.extend(lines)


def test_input_typed_before_a_question_does_not_answer_it(
    keyboard: int, types: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    os.write(keyboard, b"yes\n1.0 2.0 3.0\nhalf a li")
    types("no")
    assert not Prompt().confirm("Write the cell?")
    assert "discarded input typed before the question: yes ⏎ 1.0 2.0 3.0" in capsys.readouterr().out


def test_enter_accepts_no_other_answer(
    types: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    types("no", "wait", "")
    Prompt().enter("Enter when it is mounted")
    said = capsys.readouterr().out
    assert "found 'no', expected Enter" in said
    assert "found 'wait', expected Enter" in said


def test_session_commands_work_where_enter_is_expected(types: Callable[..., None]) -> None:
    types("undo")
    with pytest.raises(SessionCommand, match="undo"):
        Prompt().enter("Enter when it is mounted")
