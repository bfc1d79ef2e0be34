"""A profile's YAML with the places of its keys, so that messages can point at the line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from gapbridge.core.errors import InputError
from gapbridge.core.files import read_text


class ProfileError(InputError):
    """A profile or its DBC cannot be used; the message names file, line and key."""


class _Loader(yaml.SafeLoader):
    """YAML 1.1 with the floats and booleans of YAML 1.2.

    PyYAML alone reads 2e-3 as a text, and a signal called ``on`` as true.
    """

    yaml_implicit_resolvers = {  # noqa: RUF012 - PyYAML's own way, copied when it is extended
        first: [(tag, found) for tag, found in resolvers if tag != "tag:yaml.org,2002:bool"]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


_BOOLEAN = re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$")
_FLOAT = re.compile(r"^[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)[eE][-+]?[0-9]+$")
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _FLOAT, list("-+0123456789."))
_Loader.add_implicit_resolver("tag:yaml.org,2002:bool", _BOOLEAN, list("tTfF"))


@dataclass(frozen=True)
class ProfileDocument:
    """One YAML file: its nodes, which know their lines, and its data."""

    path: Path
    root: yaml.Node
    data: dict[str, Any]

    def line(self, keys: Sequence[str | int]) -> int:
        """Return the line (from 1) of a key path, or of its nearest parent in the file."""
        node, line = self.root, self.root.start_mark.line + 1
        for key in keys:
            found: yaml.Node | None = None
            if isinstance(node, yaml.MappingNode):
                for name, value in node.value:
                    if name.value == str(key):
                        found, line = value, name.start_mark.line + 1
            elif isinstance(node, yaml.SequenceNode) and key in range(len(node.value)):
                found = node.value[int(key)]
                line = found.start_mark.line + 1
            if found is None:
                break
            node = found
        return int(line)

    def error(self, keys: Sequence[str | int], message: str) -> ProfileError:
        """Return the error that says ``words`` about a key path."""
        name = ".".join(str(key + 1) if isinstance(key, int) else key for key in keys)
        return ProfileError(f"{self.path}, line {self.line(keys)}: {name}: {message}")


def read_profile_document(path: Path) -> ProfileDocument:
    """Return a profile's YAML. Raises ProfileError where it cannot be read or is broken."""
    try:
        loader = _Loader(read_text(path, "utf-8-sig"))
        root = loader.get_single_node()
        if not isinstance(root, yaml.MappingNode):
            raise ProfileError(f"{path}, line 1: found no keys, expected a profile (dbc: ...)")
        _refuse_doubles(root, path)
        data = loader.construct_document(root)
    except FileNotFoundError:
        raise ProfileError(f"{path}: file not found, expected a profile (YAML)") from None
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "found bytes that are no text"
        raise ProfileError(f"{path}: cannot be read: {why}") from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        what = " ".join(str(error.problem or error.context or "broken YAML").split())
        line = mark.line + 1 if mark else 1
        raise ProfileError(f"{path}, line {line}: found broken YAML: {what}") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        what = " ".join(str(error).split())
        raise ProfileError(f"{path}: found broken YAML: {what}") from None
    return ProfileDocument(path, root, data)


def _refuse_doubles(node: yaml.Node, path: Path) -> None:
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _refuse_doubles(item, path)
    elif isinstance(node, yaml.MappingNode):
        keys: set[str] = set()
        for key, value in node.value:
            if key.value in keys:
                line = key.start_mark.line + 1
                raise ProfileError(f"{path}, line {line}: {key.value}: found twice, expected once")
            keys.add(key.value)
            _refuse_doubles(value, path)
