"""Keeping secrets out of recordings."""

from __future__ import annotations

import re

HIDDEN = "REDACTED"
_SECRET = re.compile(r"(token|password|passwd|passphrase|secret|credential|api_?key)", re.I)
_PAIR = re.compile(
    r"""(?P<head>(?:^|[\s{,])["']?(?P<key>[\w.-]+)["']?\s*:[ \t]*)
        (?P<value>"(?:[^"\\]|\\.)*"|'(?:[^']|'')*'|[^\s#,}\[{][^#\n,}]*)""",
    re.X | re.M,
)
_BLOCK = re.compile(r"^(?P<indent>\s*)[\w.-]+\s*:\s*[|>][-+0-9]*\s*$")


def redacted(text: str) -> str:
    """Return the text of a cell file without the values of keys that hold secrets.

    A key holds one where its name says so: token, password, secret, credential, api_key, ... A
    path to a file that holds the secret is no secret: keys that end in ``_file`` stay.
    """

    def hide(match: re.Match[str]) -> str:
        key = match["key"]
        if not _SECRET.search(key) or key.lower().endswith("_file"):
            return match[0]
        return match["head"] + HIDDEN

    return "\n".join(_without_blocks(_PAIR.sub(hide, text).split("\n")))


def _without_blocks(lines: list[str]) -> list[str]:
    """Hide texts of several lines (``key: |``) under keys that hold secrets."""
    found: list[str] = []
    inside: int | None = None  # indent of the key whose block is hidden
    for line in lines:
        indent = len(line) - len(line.lstrip())
        if inside is not None and (indent > inside or not line.strip()):
            continue
        inside = None
        match = _BLOCK.match(line)
        if match and _SECRET.search(line.split(":")[0]):
            inside = indent
            line = line.split(":")[0] + f": {HIDDEN}"
        found.append(line)
    return found
