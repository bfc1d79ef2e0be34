"""A profile's YAML with the lines of its keys, for messages."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ValidationError

from gapbridge.core.errors import InputError, Keys
from gapbridge.core.files import Document, Kind, loaders, read_yaml
from gapbridge.drivers.validation import validation_errors


class ProfileError(InputError):
    """A profile or its DBC cannot be used; the message names file, line and key."""


class ProfileDocument(Document):
    """One profile: its nodes with their lines, and its data."""

    def error(self, keys: Keys, message: str) -> ProfileError:
        """Return an error with ``message`` about a key path."""
        return ProfileError(f"{self.path}, line {self.line(keys)}: {name_of(keys)}: {message}")

    def require_joints(self, count: int, expected: int | None) -> None:
        """Raise ProfileError if a profile has not ``expected`` joints; None: any number."""
        if expected is not None and count != expected:
            raise self.error(("joints",), f"found {count}, expected {expected}: the arm has those")


def name_of(keys: Keys) -> str:
    """Return a key path for messages, with list items counted from 1."""
    return ".".join(str(key + 1) if isinstance(key, int) else key for key in keys)


Schema = TypeVar("Schema", bound=BaseModel)
# a signal may be called ``on``
PROFILE = Kind("profile", "a profile", "name: ...", ProfileError, loaders(on_is_text=True))


def read_profile_file(path: Path, schema: type[Schema]) -> tuple[ProfileDocument, Schema]:
    """Return a profile's YAML and its validated ``schema``.

    Raises ProfileError, also if the file cannot be read or parsed.
    """
    source = read_yaml(path, PROFILE)
    document = ProfileDocument(source.path, source.text, source.root, source.data)
    try:
        return document, schema.model_validate(document.data)
    except ValidationError as error:
        keys, text = validation_errors(schema, error)[0]
        raise document.error(keys, text) from None
