"""What the pages show of the terminal is what the commands print: every word stands in a message.

Numbers, names of parameters and what the person typed aside. A message that was reworded since its
page was written is found here; `python -m benchmarks.evidence.transcript` writes the page anew.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from gapbridge.bridge.ipc.loop_state import State

ROOT = Path(__file__).resolve().parents[3]
PAGES = ("docs/transcript.md", "docs/first-cell.md")
WORD = re.compile(r"[A-Za-zµ_']+")


@cache
def messages() -> tuple[str, frozenset[str]]:
    """Return every text of the product joined, and the words of those of one or two words."""
    texts = [
        node.value
        for folder in ("bridge", "core", "drivers")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    ]
    fixed = (re.sub(r"\{.*?\}", " ", text) for text in texts)
    short = [found for text in fixed if len(found := WORD.findall(text)) <= 2]
    return "\n".join(texts), frozenset(word for words in short for word in words)


def blocks(page: str) -> Iterator[tuple[str, list[str]]]:
    """Yield the language of every block of a page, and its lines."""
    for block in re.findall(r"^```(.*?)^```", page, re.DOTALL | re.MULTILINE):
        language, _, body = block.partition("\n")
        yield language, body.splitlines()


def typed_in(page: str) -> set[str]:
    """Return the words of the commands and cells of a page."""
    return {
        word
        for language, lines in blocks(page)
        for line in lines
        if language or line.startswith(("$", "gapbridge "))
        for word in WORD.findall(line)
    }


def strangers(line: str, known: set[str]) -> list[str]:
    """Return the words of a line of which no message is made, as few as there can be.

    Two words and more count where they stand so in a text of the product, a single one where it is
    such a text alone, a name, or ``known``.
    """
    corpus, alone = messages()
    words = list(WORD.finditer(line))
    least: list[list[str]] = [[]]  # of the first so many words
    for end, word in enumerate(words, start=1):
        text = word.group()
        named = text in alone or text in known or "_" in text or len(text) < 3
        best = least[-1] + ([] if named else [text])
        for begin in range(end - 2, -1, -1):
            if line[words[begin].start() : word.end()] not in corpus:
                break
            best = min(best, least[begin], key=len)
        least.append(best)
    return least[-1]


@pytest.mark.parametrize("name", PAGES)
def test_what_a_page_shows_is_what_the_commands_print(name: str) -> None:
    page = (ROOT / name).read_text(encoding="utf-8")
    known = typed_in(page) | {state.name.lower() for state in State}
    shown = [
        line
        for language, lines in blocks(page)
        for line in lines
        if not language and line.strip() and not line.startswith(("$", "gapbridge "))
    ]
    assert len(shown) > 5
    assert {line: found for line in shown if (found := strangers(line, known))} == {}


def test_a_message_that_no_command_prints_is_found() -> None:
    assert strangers("cell.yaml: fit to be used with its controller", set()) == []
    assert strangers("cell.yaml: splendid to be employed by its controller", set()) != []
    assert strangers("the fault diminishes from 0.9 to 0.03 mm rms", set()) != []
