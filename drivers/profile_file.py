"""A profile's YAML with the places of its keys, so that messages can point at the line."""

from __future__ import annotations

from pathlib import Path

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from gapbridge.core.errors import InputError
from gapbridge.core.files import Document, Keys, Kind, loaders, quoted, read_yaml


class ProfileError(InputError):
    """A profile or its DBC cannot be used; the message names file, line and key."""


class ProfileDocument(Document):
    """One profile: its nodes, which know their lines, and its data."""

    def error(self, keys: Keys, message: str) -> ProfileError:
        """Return the error that says ``message`` about a key path."""
        name = ".".join(str(key + 1) if isinstance(key, int) else key for key in keys)
        return ProfileError(f"{self.path}, line {self.line(keys)}: {name}: {message}")


def worst_of(error: ValidationError) -> ErrorDetails:
    """Return the first of what pydantic says; a misspelt key comes before the one it lacks."""
    return min(error.errors(), key=lambda detail: detail["type"] != "extra_forbidden")


def found_and_expected(detail: ErrorDetails) -> str:
    """Return what a file has where another value belongs."""
    expected = detail["msg"].removeprefix("Input should be ")
    return f"found {quoted(detail['input'])}, expected {expected}"


# a signal may be called ``on``
PROFILE = Kind("profile", "a profile", "dbc: ...", ProfileError, loaders(on_is_text=True))


def read_profile_document(path: Path) -> ProfileDocument:
    """Return a profile's YAML. Raises ProfileError where it cannot be read or is broken."""
    found = read_yaml(path, PROFILE)
    return ProfileDocument(found.path, found.text, found.root, found.data)
