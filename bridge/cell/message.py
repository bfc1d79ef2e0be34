"""Errors in a cell file as one-line messages."""

from __future__ import annotations

from pydantic import BaseModel, ValidationError

from gapbridge.core.errors import InputError, Keys, key_path
from gapbridge.core.files import Document
from gapbridge.drivers import validation


def located(document: Document, error: InputError) -> InputError:
    """Return an error about a key of a cell as one that also names its file and line."""
    return type(error)(located_message(document, error))


def located_message(document: Document, error: InputError) -> str:
    """Return an error's message with file and line; without a key it names its place itself."""
    if error.keys is None:
        return str(error)
    return message_at(document, error.keys, error.message)


def message_at(document: Document, keys: Keys, text: str) -> str:
    """Return a message about a key: its file, its line where the file has its section, its path."""
    line = f", line {document.line(keys)}" if keys[0] in document.data else ""
    return f"{document.path}{line}: {key_path(keys)}: {text}"


def error_lines(document: Document, schema: type[BaseModel], error: ValidationError) -> list[str]:
    """Return a line per error: file, line, key path, what was found, what was expected."""
    return [
        f"{document.path}, line {document.line(keys)}: {text}"
        for keys, text in validation_errors(schema, error)
    ]


def validation_errors(schema: type[BaseModel], error: ValidationError) -> list[tuple[Keys, str]]:
    """Return the keys of each error and its text with them."""
    return [
        (keys, f"{key_path(keys)}: {text}")
        for keys, text in validation.validation_errors(schema, error)
    ]
