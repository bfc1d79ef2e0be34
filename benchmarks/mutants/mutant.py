"""One mistake: where it stands, what it says instead, and the tests that must notice it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import yaml

from gapbridge.core.errors import InputError
from gapbridge.core.files import loaders

LISTS = Path(__file__).parent / "lists"


@dataclass(frozen=True)
class Mutant:
    """A text of a file that is replaced by another one.

    ``file`` and ``tests`` (files, or files with ``::test``) are relative to the checkout.
    """

    what: str  # what goes wrong, in a few words
    file: str
    find: str
    replace: str
    tests: tuple[str, ...]

    @property
    def folder(self) -> str:
        """Return the folder that the table counts it in: at most one below the layer's."""
        return "/".join(Path(self.file).parent.parts[:2])

    def text(self, root: Path) -> str:
        """Return the file with the mistake. Raises InputError where its text is not there once."""
        text = (root / self.file).read_text(encoding="utf-8")
        count = text.count(self.find)
        if count != 1:
            raise InputError(
                f"{self.file}: found {self.find!r} {count} times, expected once ({self.what})"
            )
        return text.replace(self.find, self.replace)


def read_mutants(folder: Path = LISTS) -> list[Mutant]:
    """Return the mutants of all lists. Raises InputError for one that is not whole."""
    found, fastest = [], loaders()[0]
    for path in sorted(folder.glob("*.yaml")):
        for number, given in enumerate(yaml.load(path.read_text(encoding="utf-8"), fastest), 1):
            try:
                found.append(Mutant(**{**given, "tests": tuple(given["tests"])}))
            except (KeyError, TypeError) as error:
                raise InputError(f"{path}: mutant {number}: {error}") from None
    return found
