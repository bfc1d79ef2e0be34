"""Reading the YAML of a cell file, and numbers that every YAML version reads as numbers."""

from __future__ import annotations

import re
from pathlib import Path

from gapbridge.core.errors import CellError
from gapbridge.core.files import Document, Kind, loaders, parse_yaml, read_yaml

CELL_KIND = Kind("cell", "a cell file", "robot: ...", CellError, loaders())


def parse(text: str, path: Path) -> Document:
    """Return the document of a cell's text; raises CellError as parse_yaml does."""
    return parse_yaml(text, path, CELL_KIND)


def read_document(path: Path) -> Document:
    """Return the document of a cell file; raises CellError if it cannot be read."""
    return read_yaml(path, CELL_KIND)


def number_text(value: float) -> str:
    """Return a float as text that every YAML reader takes for the same number, exactly.

    ``repr`` gives ``1e-05``, which YAML 1.1 readers take for a string.
    """
    text = repr(float(value))
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return re.sub(r"e(?=\d)", "e+", text)
