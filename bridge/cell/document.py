"""A YAML file with the places of its keys, so that messages and edits can point at them."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from gapbridge.core.errors import CellError
from gapbridge.core.files import read_text

Keys = Sequence[str | int]


class _Loader(yaml.SafeLoader):
    """YAML 1.1 with the floats of YAML 1.2: PyYAML alone reads 2e-5 as a text."""


_FLOAT = re.compile(
    r"^(?:[-+]?(?:[0-9][0-9_]*)(?:\.[0-9_]*)?(?:[eE][-+]?[0-9]+)"
    r"|[-+]?\.[0-9][0-9_]*(?:[eE][-+]?[0-9]+)?)$"
)
LOADERS: list[Any] = [_Loader]
"""The quickest first; the last one's messages are those that ``PROBLEMS`` knows."""
if hasattr(yaml, "CSafeLoader"):  # a tenth of a second less for a cell with a fit's covariance

    class _QuickLoader(yaml.CSafeLoader):
        """The same, by libyaml."""

    LOADERS.insert(0, _QuickLoader)
for loader_class in LOADERS:
    loader_class.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789."))


# What PyYAML says of common slips, as found and expected.
PROBLEMS = {
    r"'\t' that cannot start any token": "found a tab, expected spaces",
    "found another document": "found a second document (---), expected one cell in a file",
    "could not determine a constructor for the tag": "found a tag (!), expected plain values",
}


@dataclass(frozen=True)
class Document:
    """One YAML file: its text, its nodes (with their marks) and its data."""

    path: Path
    text: str
    root: yaml.MappingNode
    data: dict[str, Any]

    def node(self, keys: Keys) -> yaml.Node | None:
        """Return the node at a key path, or None where there is none."""
        node: yaml.Node | None = self.root
        for key in keys:
            if isinstance(node, yaml.MappingNode):
                node = next((v for k, v in node.value if k.value == key), None)
            elif isinstance(node, yaml.SequenceNode) and isinstance(key, int):
                node = node.value[key] if key < len(node.value) else None
            else:
                return None
        return node

    def line(self, keys: Keys) -> int:
        """Return the line (from 1) of a key path, or of its nearest parent in the file."""
        for length in range(len(keys), 0, -1):
            parent = self.node(keys[: length - 1])
            if isinstance(parent, yaml.MappingNode):
                for key, _ in parent.value:
                    if key.value == keys[length - 1]:
                        return int(key.start_mark.line) + 1
            node = self.node(keys[:length])
            if node is not None:
                return int(node.start_mark.line) + 1
        return int(self.root.start_mark.line) + 1


def parse(text: str, path: Path) -> Document:
    """Return the document of a YAML text; ``path`` is for messages.

    Raises CellError, naming the line, for broken YAML, for a key that stands twice, and where the
    top is not a mapping.
    """
    try:
        loader, root = _loaded(text)
        if root is None:
            raise CellError(f"{path}: found an empty file, expected a cell (robot, tool, ...)")
        if not isinstance(root, yaml.MappingNode):
            line = root.start_mark.line + 1
            raise CellError(f"{path}, line {line}: found no keys, expected a cell (robot: ...)")
        _refuse_doubles(root, path, set())
        data = loader.construct_document(root)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        what = " ".join(str(error.problem or error.context or "broken YAML").split())
        for problem, said in PROBLEMS.items():
            if problem in what:
                raise CellError(f"{path}, line {line}: {said}") from None
        raise CellError(f"{path}, line {line}: found broken YAML: {what}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        what = " ".join(str(error).split())
        raise CellError(f"{path}: found broken YAML: {what}") from None
    return Document(path, text, root, data)


def _loaded(text: str) -> tuple[Any, yaml.Node | None]:
    """Return a loader of a text, and the text's one node."""
    for loader_class in LOADERS[:-1]:
        try:
            loader = loader_class(text)
            return loader, loader.get_single_node()
        except yaml.YAMLError:
            pass
    loader = LOADERS[-1](text)
    return loader, loader.get_single_node()


def read_document(path: Path) -> Document:
    """Return the document of a YAML file; raises CellError where it cannot be read."""
    try:
        text = read_text(path, "utf-8-sig")
    except FileNotFoundError:
        raise CellError(f"{path}: file not found, expected a cell file (YAML)") from None
    except IsADirectoryError:
        raise CellError(f"{path}: found a folder, expected a cell file (YAML)") from None
    except UnicodeDecodeError:
        raise CellError(f"{path}: found bytes that are no text, expected YAML (UTF-8)") from None
    except OSError as error:
        raise CellError(f"{path}: cannot be read: {error.strerror}") from None
    return parse(text, path)


def _refuse_doubles(node: yaml.Node, path: Path, seen: set[int]) -> None:
    if id(node) in seen:
        return
    seen.add(id(node))
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _refuse_doubles(item, path, seen)
    elif isinstance(node, yaml.MappingNode):
        keys: set[str] = set()
        for key, value in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                if key.value in keys:
                    line = key.start_mark.line + 1
                    raise CellError(f"{path}, line {line}: {key.value}: found twice, expected once")
                keys.add(key.value)
            _refuse_doubles(value, path, seen)


def number_text(value: float) -> str:
    """Return a float as every YAML reader takes it for a number; reading it gives it back exactly.

    ``repr`` gives ``1e-05``, which YAML 1.1 readers take for a text.
    """
    text = repr(float(value))
    if "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return re.sub(r"e(?=\d)", "e+", text)
