"""A cell file's YAML, and numbers as every YAML reader takes them."""

from __future__ import annotations

import re
from pathlib import Path

from gapbridge.core.errors import CellError
from gapbridge.core.files import Document, Kind, loaders, parse_yaml, read_yaml

CELL = Kind("cell", "a cell file", "robot: ...", CellError, loaders())


def parse(text: str, path: Path) -> Document:
    """Return the document of a cell's text; raises CellError as parse_yaml does."""
    return parse_yaml(text, path, CELL)


def read_document(path: Path) -> Document:
    """Return the document of a cell file; raises CellError where it cannot be read."""
    return read_yaml(path, CELL)


def number_text(value: float) -> str:
    """Return a float as every YAML reader takes it for a number; reading it gives it back exactly.

    ``repr`` gives ``1e-05``, which YAML 1.1 readers take for a text.
    """
    text = repr(float(value))
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return re.sub(r"e(?=\d)", "e+", text)
