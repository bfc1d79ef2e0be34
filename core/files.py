"""Reading the files of a configuration.

All files of a cell are read by these functions. A process may record what it reads (``recorded``)
and pass it to another process, which then reads those bytes only (``read_only_given``): both use
the same configuration even if a file was edited meanwhile.

A ``Document`` is a YAML file with the positions of its keys, for messages and edits.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import os
import re
from collections.abc import Iterator, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from gapbridge.core.errors import InputError, Keys

MAX_QUOTED = 60  # characters of a value that a message quotes
MAX_DIGITS = 1000  # of a whole number; Python converts no more than 4300

_INTEGER = re.compile(
    r"^[-+]?(?:0b[0-1]+|0x[0-9a-fA-F]+|0|[1-9][0-9]*)$"  # 010, 1:30, 1_0: texts
)
_FLOAT = re.compile(
    r"^(?:[-+]?[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)"
    r"|[-+]?[0-9]+\.[0-9]*"
    r"|[-+]?\.[0-9]+(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$"
)
_NO_CHARACTER = re.compile("[\0\ud800-\udfff]")
_BOOLEAN = re.compile(r"^(?:true|True|TRUE|false|False|FALSE)$")
YAML_11_BOOLEAN = "tag:yaml.org,2002:bool"
_NUMBERS = {"tag:yaml.org,2002:int": _INTEGER, "tag:yaml.org,2002:float": _FLOAT}
# What PyYAML says of common slips, as found and expected.
PROBLEMS = {
    r"'\t' that cannot start any token": "found a tab, expected spaces",
    "found another document": "found a second document (---), expected one {name} in a file",
    "could not determine a constructor for the tag": "found a tag (!), expected plain values",
}

_recording: ContextVar[dict[str, bytes] | None] = ContextVar("_recording", default=None)
_given_files: Mapping[str, bytes] | None = None


def read_bytes(path: Path) -> bytes:
    """Return a file's bytes. Raises OSError."""
    if _given_files is not None:
        for key in _keys(path):
            if key in _given_files:
                return _given_files[key]
        message = "not among the files of the configuration that runs"
        raise FileNotFoundError(errno.ENOENT, message, str(path))
    content = path.read_bytes()
    if (recording := _recording.get()) is not None:
        recording.update(dict.fromkeys(_keys(path), content))
    return content


def _keys(path: Path) -> tuple[str, str]:
    """Return the absolute paths of a file, with symbolic links unresolved and resolved."""
    return os.path.abspath(path), os.path.realpath(path)


def read_text(path: Path, encoding: str = "utf-8") -> str:
    """Return a file's text, line ends as newlines. Raises OSError, UnicodeDecodeError."""
    return read_bytes(path).decode(encoding).replace("\r\n", "\n").replace("\r", "\n")


def require_utf8(path: Path) -> None:
    """Raise InputError for a path that is not UTF-8, which tables and many libraries do not take.

    Names of files may hold any bytes.
    """
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise InputError(f"{path}: found a name that is not UTF-8, expected one that is") from None


def is_given() -> bool:
    """Return whether this process reads only files passed by another one."""
    return _given_files is not None


def is_file(path: Path) -> bool:
    """Return whether there is a file to read."""
    if _given_files is not None:
        return any(key in _given_files for key in _keys(path))
    try:
        return path.is_file()
    except OSError:  # a name that is too long
        return False


@contextlib.contextmanager
def recorded() -> Iterator[dict[str, bytes]]:
    """Collect the files read in this context, by absolute path; in this thread only."""
    content: dict[str, bytes] = {}
    token = _recording.set(content)
    try:
        yield content
    finally:
        _recording.reset(token)


def read_only_given(files: Mapping[str, bytes]) -> None:
    """Restrict this process to these files from now on."""
    global _given_files
    _given_files = dict(files)


def loaders(*, on_is_text: bool = False) -> tuple[Any, ...]:
    """Return loaders of YAML 1.1 whose numbers mean the same in YAML 1.2.

    PyYAML alone reads 2e-5 as a text, 010 as 8, 1:30 as 90 and 1_0 as 10; the last three are texts
    here, which no number accepts. ``on_is_text``: with the booleans of 1.2 too. The quickest loader
    (libyaml's, which saves a tenth of a second for a cell with a fit's covariance) comes first; the
    last one's messages are those that ``PROBLEMS`` knows.
    """
    fast = (yaml.CSafeLoader,) if hasattr(yaml, "CSafeLoader") else ()
    return tuple(_loader(base, on_is_text) for base in (*fast, yaml.SafeLoader))


def _loader(base: Any, on_is_text: bool) -> Any:
    resolvers = {
        first: [
            (tag, _NUMBERS.get(tag, content))
            for tag, content in all_of
            if not (on_is_text and tag == YAML_11_BOOLEAN)
        ]
        for first, all_of in base.yaml_implicit_resolvers.items()
    }
    content: Any = type("_Loader", (base,), {"yaml_implicit_resolvers": resolvers})
    if on_is_text:
        content.add_implicit_resolver(YAML_11_BOOLEAN, _BOOLEAN, list("tTfF"))
    return content


class Kind(NamedTuple):
    """One kind of YAML file: how it is loaded, and what messages call it."""

    name: str  # cell
    file: str  # a cell file
    keys: str  # robot: ...
    error: type[InputError]
    loaders: tuple[Any, ...]


def quoted(value: object) -> str:
    """Return the ``repr`` of a value in one short line."""
    text = " ".join(repr(value).split())
    return text if len(text) <= MAX_QUOTED else f"{text[:MAX_QUOTED]}..."


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
                node = next((v for k, v in node.value if k.value == str(key)), None)
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
                    if key.value == str(keys[length - 1]):
                        return int(key.start_mark.line) + 1
            node = self.node(keys[:length])
            if node is not None:
                return int(node.start_mark.line) + 1
        return int(self.root.start_mark.line) + 1


def parse_yaml(text: str, path: Path, kind: Kind) -> Document:
    """Return the document of a YAML text; ``path`` is for messages.

    Raises the kind's error, naming the line, for broken YAML, for a duplicate key, and where the
    top level is not a mapping.
    """
    try:
        loader, root = _load(text, kind)
        if not isinstance(root, yaml.MappingNode):
            where = path if root is None else f"{path}, line {root.start_mark.line + 1}"
            content = "an empty file" if root is None else "no keys"
            raise kind.error(f"{where}: found {content}, expected a {kind.name} ({kind.keys})")
        _require_plain(root, path, kind, set())
        data = _constructed(loader, root, path, kind)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        what = " ".join(str(error.problem or error.context or "broken YAML").split())
        for problem, text_of_problem in PROBLEMS.items():
            if problem in what:
                text = text_of_problem.format(name=kind.name)
                raise kind.error(f"{path}, line {line}: {text}") from None
        raise kind.error(f"{path}, line {line}: found broken YAML: {what}") from None
    except RecursionError:
        raise kind.error(f"{path}: found values nested too deep, expected a few levels") from None
    except (yaml.YAMLError, ValueError) as error:
        what = " ".join(str(error).split())
        raise kind.error(f"{path}: found broken YAML: {what}") from None
    return Document(path, text, root, data)


def _constructed(loader: Any, root: yaml.Node, path: Path, kind: Kind) -> Any:
    """Return the data of a document; raises the kind's error for a value that is not of its type.

    As a date with a 13th month, or a text with a tag of numbers; PyYAML has no error of its own
    for these.
    """
    try:
        return loader.construct_document(root)
    except (ValueError, LookupError, AttributeError, TypeError):
        anew = kind.loaders[-1]("")  # the first one stands in the middle of its work
        for node in _scalars(root, set()):
            try:
                anew.construct_object(node)
            except (ValueError, LookupError, AttributeError, TypeError):
                line, what = node.start_mark.line + 1, node.tag.rsplit(":", 1)[-1]
                raise kind.error(
                    f"{path}, line {line}: found {quoted(node.value)}, expected a valid {what}"
                ) from None
        raise


def _scalars(node: Any, seen: set[int]) -> Iterator[yaml.ScalarNode]:
    """Yield the scalars below a node, of which aliases may hold some several times."""
    if id(node) in seen:
        return
    seen.add(id(node))
    if isinstance(node, yaml.ScalarNode):
        yield node
    elif isinstance(node, yaml.MappingNode):
        for pair in node.value:
            for part in pair:
                yield from _scalars(part, seen)
    else:
        for item in node.value:
            yield from _scalars(item, seen)


def _load(text: str, kind: Kind) -> tuple[Any, yaml.Node | None]:
    """Return a loader of a text, and the text's one node."""
    for loader_class in kind.loaders[:-1]:
        try:
            loader = loader_class(text)
            return loader, loader.get_single_node()
        except yaml.YAMLError:
            pass
    loader = kind.loaders[-1](text)
    return loader, loader.get_single_node()


def read_yaml(path: Path, kind: Kind) -> Document:
    """Return the document of a YAML file; raises the kind's error where it cannot be read.

    A device is refused, since some never end; a pipe is read.
    """
    try:
        if not is_given() and (path.is_char_device() or path.is_block_device()):
            raise kind.error(f"{path}: found a device, expected {kind.file} (YAML)")
        text = read_text(path, "utf-8-sig")
    except FileNotFoundError:
        raise kind.error(f"{path}: file not found, expected {kind.file} (YAML)") from None
    except IsADirectoryError:
        raise kind.error(f"{path}: found a folder, expected {kind.file} (YAML)") from None
    except UnicodeDecodeError:
        raise kind.error(f"{path}: found bytes that are no text, expected YAML (UTF-8)") from None
    except OSError as error:
        raise kind.error(f"{path}: cannot be read: {error.strerror}") from None
    return parse_yaml(text, path, kind)


def _require_plain(node: yaml.Node, path: Path, kind: Kind, seen: set[int]) -> None:
    """Raise the kind's error for a key that comes twice, and for what no value can have.

    That is NUL, which no path may have, half of a surrogate pair, which is no character, a decimal
    comma, and digits without an end.
    """
    if id(node) in seen:
        return
    seen.add(id(node))
    if isinstance(node, yaml.ScalarNode) and (found := _NO_CHARACTER.search(node.value)):
        line = node.start_mark.line + 1
        what = "\\0" if found[0] == "\0" else ascii(found[0])[1:-1]
        raise kind.error(
            f"{path}, line {line}: found {quoted(node.value)}, expected no {what} in it"
        )
    if node.tag == "tag:yaml.org,2002:int" and len(node.value) > MAX_DIGITS:
        line = node.start_mark.line + 1
        raise kind.error(f"{path}, line {line}: found {quoted(node.value)}, expected fewer digits")
    if isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _require_plain(item, path, kind, seen)
    elif isinstance(node, yaml.MappingNode):
        keys: set[str] = set()
        _require_decimal_points(node, path, kind)
        for key, value in node.value:
            if isinstance(key, yaml.ScalarNode):
                if key.value in keys:
                    line = key.start_mark.line + 1
                    raise kind.error(
                        f"{path}, line {line}: {key.value}: found twice, expected once"
                    )
                keys.add(key.value)
            _require_plain(value, path, kind, seen)


def _require_decimal_points(node: yaml.MappingNode, path: Path, kind: Kind) -> None:
    """Raise the kind's error for ``{mass: 5,5}``, which YAML reads as {mass: 5, 5: null}."""
    for (name, whole), (decimals, rest) in itertools.pairwise(node.value):
        if (
            rest.value == ""
            and isinstance(whole, yaml.ScalarNode)
            and re.fullmatch(r"[-+]?\d+", whole.value)
            and isinstance(decimals, yaml.ScalarNode)
            and re.fullmatch(r"\d+([eE][-+]?\d+)?", decimals.value)
        ):
            raise kind.error(
                f"{path}, line {whole.start_mark.line + 1}: {name.value}: found a decimal comma "
                f"({whole.value},{decimals.value}), expected a point ({whole.value}."
                f"{decimals.value})"
            )
