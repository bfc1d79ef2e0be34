"""Reading the YAML of a cell file, and writing values that every YAML version reads alike."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import yaml

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


class CellDumper(yaml.SafeDumper):
    """YAML whose numbers read back exactly, and whose texts read back as texts."""

    def ignore_aliases(self, data: Any) -> bool:
        """Write no aliases."""
        return True


CellDumper.add_representer(
    float, lambda d, value: d.represent_scalar("tag:yaml.org,2002:float", number_text(value))
)
for _first, _resolvers in CELL_KIND.loaders[-1].yaml_implicit_resolvers.items():
    for _tag, _pattern in _resolvers:  # 1e5 as a text: quoted, since cells are read as YAML 1.2
        CellDumper.add_implicit_resolver(_tag, _pattern, [_first])


def one_line(value: Any) -> str:
    """Return a value as YAML in one line, quoted where it has to be."""
    text = yaml.dump(value, Dumper=CellDumper, default_flow_style=True, width=10**6)
    return str(text).split("\n")[0]
