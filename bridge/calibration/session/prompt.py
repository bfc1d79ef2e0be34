"""The terminal of a session: what is said, what is asked, and the words that work everywhere."""

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

T = TypeVar("T")
LOOK = 0.1  # s between two looks at what is waited for
COMMANDS = {
    "undo": "discard the last reading and measure that pose again",
    "back": "measure an earlier pose again: has the instrument or the target moved?",
    "moved": "the instrument has been moved: new frame from the next reading on",
    "slipped": "the target has moved on the tool: from the next reading on",
    "skip": "skip this pose",
    "note": "write a note into the journal: note TEXT",
    "quit": "stop here; rerun the command to resume",
}
ENTER = "continue: the load is mounted, the arm is in place, measure"
HELP = "list these commands"
_SHORT = {"u": "undo", "b": "back", "q": "quit", "exit": "quit", "h": "?", "help": "?"}


class SessionCommand(Exception):  # noqa: N818 - an answer, no failure
    """A person typed one of WORDS instead of an answer."""

    def __init__(self, name: str, rest: str = "") -> None:
        super().__init__(name)
        self.name, self.rest = name, rest


class InputEnded(Exception):  # noqa: N818
    """Nobody is there to answer: the input has come to its end."""


class Prompt:
    """One terminal. ``note`` gets every note that a person writes."""

    def __init__(self, note: Callable[[str], None] = lambda _: None) -> None:
        self.console = Console(highlight=False, soft_wrap=True)
        self.note = note
        self._typed = _Lines()

    def say(self, text: str = "", style: str | None = None) -> None:
        """Print a line."""
        self.console.print(text, style=style, markup=False)

    def warn(self, text: str) -> None:
        """Print a line that must be seen."""
        self.say(f"! {text}", "bold yellow")

    def ask(self, question: str) -> str:
        """Return what is typed; raises SessionCommand for a command, InputEnded at the end."""
        return self.ask_unless(question, lambda: None) or ""

    def ask_unless(self, question: str, look: Callable[[], T | None]) -> str | T:
        """Return what is typed, or what ``look`` finds meanwhile, whichever comes first."""
        while True:
            typed = self._read(question, look)
            if not isinstance(typed, str):
                return typed
            if not self._is_help(typed):
                return self._answer(typed)

    def enter(self, question: str) -> None:
        """Return on Enter alone; any other answer is asked again."""
        while answer := self.ask(question):
            self.say(f"found {answer!r}, expected Enter, or a command of the session (`?`)")

    def confirm(self, question: str) -> bool:
        """Return whether a person says yes; asks until it is yes or no."""
        while True:
            answer = self.ask(f"{question} [yes/no]").lower()
            if answer in ("y", "yes", "n", "no"):
                return answer.startswith("y")
            self.say(f"found {answer!r}, expected yes or no")

    def choose(self, question: str, answers: dict[str, str]) -> str:
        """Return the key of one of the answers; Enter is the first."""
        first = next(iter(answers))
        shown = {"Enter" if key == first else key: text for key, text in answers.items()}
        for key, text in shown.items():
            self.say(f"    {key:<8} {text}")
        while True:
            answer = self.ask(question).lower()
            found = [k for k in answers if answer and k.startswith(answer)]
            if found or not answer:
                return found[0] if found else first
            self.say(f"found {answer!r}, expected {_either(list(shown))}")

    @contextmanager
    def waiting(self, text: str) -> Iterator[Callable[[str], None]]:
        """Show what is waited for while the block lasts; gives a function that changes it."""
        if not self.console.is_terminal:
            yield lambda text: None
            return
        with Status(text, console=self.console, refresh_per_second=4) as shown:
            yield lambda text: shown.update(text)

    def _read(self, question: str, look: Callable[[], T | None]) -> str | T:
        if early := self._typed.flush():
            self.say(f"  discarded input typed before the question: {early}", "yellow")
        self.console.print(f"{question} > ", end="", markup=False, style="bold")
        self.console.file.flush()
        while True:
            line = self._typed.line(LOOK)
            if line is not None:
                if not sys.stdin.isatty():
                    self.say(line)  # nothing has shown it yet
                return line.strip()
            if self._typed.ended:
                raise InputEnded
            found = look()
            if found is not None:
                self.say()
                return found

    def _is_help(self, line: str) -> bool:
        word, _, rest = line.partition(" ")
        word = _SHORT.get(word.lower(), word.lower())
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
        word, _, rest = line.partition(" ")
        name = _SHORT.get(word.lower(), word.lower())
        if name in COMMANDS:
            raise SessionCommand(name, rest.strip())
        return line


def _either(choices: list[str]) -> str:
    return choices[0] if len(choices) == 1 else f"{', '.join(choices[:-1])} or {choices[-1]}"


class _Lines:
    """Lines of the standard input, without ever waiting longer than asked."""

    def __init__(self) -> None:
        self._rest = b""
        self.ended = False

    def _took(self, wait: float) -> bool:
        """Return whether anything came within ``wait`` s, and keep it."""
        fd = sys.stdin.fileno()
        if self.ended or not select.select([fd], [], [], wait)[0]:
            return False
        data = os.read(fd, 4096)
        self.ended = not data
        self._rest += data
        return True

    def flush(self) -> str:
        """Drop what was typed at a terminal so far, and return it; a file or pipe keeps its lines.

        An answer typed before its question was meant for another one.
        """
        fd = sys.stdin.fileno()
        if not os.isatty(fd):
            return ""
        while self._took(0.0):
            pass
        termios.tcflush(fd, termios.TCIFLUSH)  # a line that has not ended yet
        early, self._rest = self._rest, b""
        return " ⏎ ".join(early.decode("utf-8", "replace").splitlines())

    def line(self, wait: float) -> str | None:
        """Return the next line, None where none comes within ``wait`` s."""
        if b"\n" not in self._rest:
            self._took(wait)
        line, end, rest = self._rest.partition(b"\n")
        if not end:
            return None
        self._rest = rest
        return line.decode("utf-8", "replace")
