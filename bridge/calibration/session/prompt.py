"""The terminal of a session: output, questions, and the commands accepted at every question."""

from __future__ import annotations

import os
import select
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.status import Status

from gapbridge.bridge.report.labels import listed

T = TypeVar("T")
POLL_INTERVAL = 0.1  # s
COMMANDS = {
    "undo": "discard the last reading, or the skip after it, and measure that pose again",
    "back": "measure an earlier pose again: has the instrument or the target moved?",
    "moved": "the instrument has been moved: new frame from the next reading on",
    "slipped": "the target has moved on the tool: from the next reading on",
    "skip": "skip this pose",
    "note": "write a note into the journal: note TEXT",
    "quit": "stop here; rerun the command to resume",
}
ENTER = "continue: the load is mounted, the arm is in place, measure"
HELP = "list these commands"
_ALIASES = {"u": "undo", "b": "back", "q": "quit", "exit": "quit", "h": "?", "help": "?"}


class SessionCommand(Exception):  # noqa: N818 - not an error
    """The operator typed one of COMMANDS instead of an answer."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.name = name


class InputEnded(Exception):  # noqa: N818
    """The standard input has ended."""


class Prompt:
    """The terminal of a session. ``note`` is called with every note that the operator types."""

    def __init__(self, note: Callable[[str], None] = lambda _: None) -> None:
        self.console = Console(highlight=False, soft_wrap=True)
        self.note = note
        self._typed = _InputLines()

    def say(self, text: str = "", style: str | None = None) -> None:
        """Print a line."""
        self.console.print(text, style=style, markup=False)

    def warn(self, text: str) -> None:
        """Print a highlighted warning."""
        self.say(f"! {text}", "bold yellow")

    def ask(self, question: str) -> str:
        """Return the typed line; raises SessionCommand for a command, InputEnded at the end."""
        return self.ask_unless(question, lambda: None) or ""

    def ask_unless(self, question: str, poll: Callable[[], T | None]) -> str | T:
        """Return the typed line, or the first result of ``poll`` that is not None."""
        while True:
            typed = self._read(question, poll)
            if not isinstance(typed, str):
                return typed
            if not self._is_help(typed):
                return self._answer(typed)

    def enter(self, question: str) -> None:
        """Return on Enter alone; after any other answer ask again."""
        while answer := self.ask(question):
            self.say(f"found {answer!r}, expected Enter, or a command of the session (`?`)")

    def confirm(self, question: str) -> bool:
        """Return whether the answer is yes; ask until it is yes or no."""
        while True:
            answer = self.ask(f"{question} [yes/no]").lower()
            if answer in ("y", "yes", "n", "no"):
                return answer.startswith("y")
            self.say(f"found {answer!r}, expected yes or no")

    def choose(self, question: str, answers: dict[str, str]) -> str:
        """Return the key of the chosen answer (key -> description); Enter chooses the first."""
        first = next(iter(answers))
        shown = {"Enter" if key == first else key: text for key, text in answers.items()}
        for key, text in shown.items():
            self.say(f"    {key:<8} {text}")
        while True:
            answer = self.ask(question).lower()
            matching = [k for k in answers if answer and k.startswith(answer)]
            if matching or not answer:
                return matching[0] if matching else first
            self.say(f"found {answer!r}, expected {listed([*shown], 'or')}")

    @contextmanager
    def waiting(self, text: str) -> Iterator[Callable[[str], None]]:
        """Show a status text while the block runs; yields a function that changes it."""
        if not self.console.is_terminal:
            yield lambda text: None
            return
        with Status(text, console=self.console, refresh_per_second=4) as shown:
            yield lambda text: shown.update(text)

    def _read(self, question: str, poll: Callable[[], T | None]) -> str | T:
        if early := self._typed.flush():
            self.say(f"  discarded input typed before the question: {early}", "yellow")
        self.console.print(f"{question} > ", end="", markup=False, style="bold")
        self.console.file.flush()
        while True:
            line = self._typed.line(POLL_INTERVAL)
            if line is not None:
                if not sys.stdin.isatty():
                    self.say(line)  # piped input is not echoed
                return line.strip()
            if self._typed.ended:
                raise InputEnded
            result = poll()
            if result is not None:
                self.say()
                return result

    def _is_help(self, line: str) -> bool:
        word, _, rest = line.partition(" ")
        word = _ALIASES.get(word.lower(), word.lower())
        if word == "?":
            self.say(f"  Enter    {ENTER}")
            for name, text in COMMANDS.items():
                self.say(f"  {name:<8} {text}")
            return True
        if word == "note":
            if rest.strip():
                self.note(rest.strip())
            self.say("noted" if rest.strip() else "found no text, expected note TEXT")
            return True
        return False

    def _answer(self, line: str) -> str:
        word = line.partition(" ")[0].lower()
        name = _ALIASES.get(word, word)
        if name in COMMANDS:
            raise SessionCommand(name)
        return line


class _InputLines:
    """Lines of the standard input, read with a timeout."""

    def __init__(self) -> None:
        self._buffer = b""
        self.ended = sys.stdin is None  # closed

    def _receive(self, wait: float) -> bool:
        """Return whether input arrived within ``wait`` s; it is added to the buffer."""
        if self.ended or not select.select([fd := sys.stdin.fileno()], [], [], wait)[0]:
            return False
        data = os.read(fd, 4096)
        self.ended = not data
        self._buffer += data
        return True

    def flush(self) -> str:
        """Discard and return input typed at a terminal so far; lines of a file or pipe are kept.

        Input typed before a question was meant for another one.
        """
        if self.ended or not os.isatty(fd := sys.stdin.fileno()):
            return ""
        while self._receive(0.0):
            pass
        termios.tcflush(fd, termios.TCIFLUSH)  # an unfinished line
        early, self._buffer = self._buffer, b""
        return " ⏎ ".join(early.decode("utf-8", "replace").splitlines())

    def line(self, wait: float) -> str | None:
        """Return the next line, None if none arrives within ``wait`` s."""
        if b"\n" not in self._buffer:
            self._receive(wait)
        line, end, rest = self._buffer.partition(b"\n")
        if not end:
            return None
        self._buffer = rest
        return line.decode("utf-8", "replace")
