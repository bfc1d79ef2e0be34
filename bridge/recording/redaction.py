"""Keeping secrets out of recordings."""

from __future__ import annotations

import re

import yaml

HIDDEN = "REDACTED"
_SECRET = re.compile(r"token|password|passwd|passphrase|secret|credential|api_?key", re.I)


def redacted(text: str) -> str:
    """Return the text of a cell file without the values of keys that hold secrets.

    A key holds one where its name says so: token, password, secret, credential, api_key, ... A
    path to a file that holds the secret is no secret: keys that end in ``_file`` stay. Text that
    is no YAML is hidden as a whole.
    """
    try:
        root = yaml.compose(text, yaml.SafeLoader)
    except yaml.YAMLError:
        return HIDDEN
    spans: set[tuple[int, int]] = set()
    _find(root, spans, set())
    for start, end in sorted(spans, reverse=True):
        tail = text[start:end]
        text = text[:start] + HIDDEN + tail[len(tail.rstrip()) :] + text[end:]
    return text


def _find(node: yaml.Node | None, spans: set[tuple[int, int]], seen: set[int]) -> None:
    """Collect where the values of secret keys stand."""
    if not isinstance(node, yaml.CollectionNode) or id(node) in seen:
        return
    seen.add(id(node))
    for item in node.value:
        if isinstance(item, yaml.Node):
            _find(item, spans, seen)
            continue
        key, value = item
        name = str(key.value)
        if _SECRET.search(name) and not name.lower().endswith("_file"):
            spans.add((value.start_mark.index, value.end_mark.index))
        else:
            _find(value, spans, seen)
