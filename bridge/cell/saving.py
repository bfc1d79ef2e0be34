"""Saving a cell with a new model: only the keys of the model change in the user's text."""

from __future__ import annotations

import copy
import json
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from gapbridge.bridge.cell.cell import Cell, cell_of
from gapbridge.bridge.cell.document import CellDumper, number_text, one_line, parse
from gapbridge.bridge.cell.effects import compliance_entry, effect_entries
from gapbridge.bridge.document.output_file import replacing
from gapbridge.core.errors import CellError, InputError, RunError
from gapbridge.core.files import Document
from gapbridge.core.model import Model

PLAIN = re.compile(r"(?!(?:y|n|yes|no|on|off|true|false|null|nan|inf)$)[a-z][a-z_]*", re.IGNORECASE)


def save_cell(
    cell: Cell, path: Path | str, model: Model | None = None, sections: dict[str, Any] | None = None
) -> None:
    """Write the cell, with effects and TCP of ``model``, to ``path``, atomically.

    ``sections`` are whole top-level keys that replace those of the cell (``payload``).

    Keys, order and comments of the user's file are kept; relative paths are rewritten for the new
    file's folder. Reading the new file gives exactly the same model.

    Raises RunError where the new cell could not be loaded, or not be written; nothing is written.
    """
    path = Path(path)
    with replacing(path) as file:  # first: in a folder that is not there no cell could be loaded
        file.write(cell_text(cell, path, model or cell.model, sections))


def _changed_tool(cell: Cell, model: Model) -> dict[str, Any]:
    """Return the key ``tool`` with the TCP of ``model``; empty if it is that of the cell."""
    shift = model.tool_in_flange[:3, 3]
    if np.array_equal(shift, cell.model.tool_in_flange[:3, 3]):
        return {}
    tool = copy.deepcopy(cell.document.data.get("tool") or {})
    tool["tcp"] = {**(tool.get("tcp") or {}), "xyz": [float(v) for v in shift]}
    return {"tool": tool}


def cell_text(cell: Cell, path: Path, model: Model, sections: dict[str, Any] | None = None) -> str:
    """Return the text of the cell file at ``path`` for ``model``; see save_cell.

    Raises RunError where the cell could not be loaded.
    """
    text = _text(cell, path, model, sections)
    try:
        cell_of(text, path)
    except InputError as error:
        raise RunError(f"nothing is written, the cell could not be loaded: {error}") from None
    return text


def _text(cell: Cell, path: Path, model: Model, sections: dict[str, Any] | None) -> str:
    document = cell.document
    changes: dict[str, Any] = _changed_tool(cell, model) | (sections or {})
    changes["compliance"] = compliance_entry(model.terms, model.arm.n)
    entries = effect_entries(model.terms, model.arm)
    if entries or "effects" in document.data:
        changes["effects"] = entries
    expected = copy.deepcopy(document.data)
    paths = _moved_paths(cell, path.parent)
    for (*parents, last), moved in paths.items():
        _value(expected, parents)[last] = moved
    edited = _edited(document, paths, changes)
    expected.update(changes)
    if edited is not None and _reads_as(edited, path, expected):
        return edited
    return yaml.dump(expected, Dumper=CellDumper, sort_keys=False, allow_unicode=True,
                     default_flow_style=None, width=100)  # fmt: skip


def _moved_paths(cell: Cell, folder: Path) -> dict[tuple[str | int, ...], str]:
    """Return the relative paths of a cell, by their keys, as they are from ``folder``."""
    old, new = cell.document.path.parent.resolve(), folder.resolve()
    return {
        keys: os.path.relpath(old / path, new)
        for keys, path in cell.file.paths()
        if old != new and not path.is_absolute()
    }


def _edited(
    document: Document, paths: Mapping[tuple[str | int, ...], str], changes: dict[str, Any]
) -> str | None:
    """Return the user's text with values replaced, or None for a top level in flow style."""
    if document.root.flow_style:
        return None
    edits: set[tuple[int, int, str]] = set()  # of an alias and its anchor: once
    for keys, moved in paths.items():
        node = document.node(keys)
        if isinstance(node, yaml.ScalarNode):
            edits.add((node.start_mark.index, node.end_mark.index, one_line(moved)))
    appended = ""
    for key, value in changes.items():
        pair = next(((k, v) for k, v in document.root.value if k.value == key), None)
        block = _block(key, value)
        if pair is None:
            appended += block
        else:
            edits.add((pair[0].start_mark.index, _end(pair[1]), block.rstrip("\n")))
    text = document.text
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    return text + ("" if text.endswith("\n") else "\n") + appended


def _value(data: Any, keys: Iterable[str | int]) -> Any:
    """Return the value at a key path that the data have."""
    for key in keys:
        data = data[key]
    return data


def _end(node: yaml.Node) -> int:
    """Return the index after a value; the end mark of a block includes comments after it."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(last[1] if isinstance(last, tuple) else last)
    return int(node.end_mark.index)


def _block(key: str, value: Any) -> str:
    """Return a top-level key, one line per list or entry."""
    if not value:
        return f"{key}: []\n"
    lines = [f"{key}:"]
    if isinstance(value, dict):
        lines += [f"  {name}: {_flow(item)}" for name, item in value.items()]
    else:
        lines += [f"  - {_flow(item)}" for item in value]
    return "\n".join(lines) + "\n"


def _flow(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{k}: {_flow(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_flow(v) for v in value) + "]"
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, str):
        return value if PLAIN.fullmatch(value) else json.dumps(value, ensure_ascii=False)
    return number_text(value) if isinstance(value, float) else str(value)


def _reads_as(text: str, path: Path, expected: dict[str, Any]) -> bool:
    try:
        return parse(text, path).data == expected
    except CellError:
        return False
