"""A DBC read by cantools and checked, its errors reported with the line that is wrong."""

from __future__ import annotations

import difflib
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gapbridge.core.files import read_text
from gapbridge.drivers.profile_file import ProfileError

_MESSAGE = re.compile(r"^\s*BO_\s+\d+\s+(\w+)\s*:")
_SIGNAL = re.compile(r"^\s+SG_\s+(\w+)\b")
_TYPE = re.compile(r"^\s*SIG_VALTYPE_\s+(\d+)\s+(\w+)\s*:?\s*(\d+)")
FLOATS = {16, 32, 64}


@dataclass(frozen=True)
class Dbc:
    """The messages of a DBC by name (cantools objects), and their lines in the file."""

    path: Path
    messages: dict[str, Any]
    lines: dict[tuple[str, str], int]

    def line(self, message: str, signal: str = "") -> int:
        """Return the line (from 1) of a message or of one of its signals."""
        return self.lines.get((message, signal), self.lines.get((message, ""), 1))

    def error(self, message: str, signal: str, detail: str) -> ProfileError:
        """Return an error with ``detail`` about a signal, or about its message."""
        name = f"{message}.{signal}" if signal else message
        return ProfileError(f"{self.path}, line {self.line(message, signal)}: {name}: {detail}")

    def nearest(self, name: str) -> str:
        """Return a hint at the nearest message or ``MESSAGE.SIGNAL``."""
        known = [*self.messages]
        if "." in name:
            known = [f"{m.name}.{s.name}" for m in self.messages.values() for s in m.signals]
        near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)
        return f"; the nearest is {near[0]}" if near else ""


def read_dbc(path: Path) -> Dbc:
    """Return the checked DBC. Raises ProfileError, naming the line, if it cannot be used."""
    import cantools

    try:
        text = read_text(path, "cp1252")
    except FileNotFoundError:
        raise ProfileError(f"{path}: file not found, expected a DBC") from None
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "found bytes that are no text"
        raise ProfileError(f"{path}: cannot be read: {why}") from None
    lines = _lines_of(text)
    _check_types(path, text)
    try:
        database: Any = cantools.database.load_string(text, "dbc", strict=False)
    except Exception as error:  # cantools raises its own, textparser's and KeyError
        raise ProfileError(f"{path}, line {_line_in(str(error))}: {_plain(error)}") from None
    messages: dict[str, Any] = {}
    message_names: dict[tuple[int, bool], str] = {}
    dbc = Dbc(path, messages, lines)
    for message in database.messages:
        if message.name in messages:
            raise dbc.error(message.name, "", "found twice, expected once")
        messages[message.name] = message
        key = (message.frame_id, message.is_extended_frame)
        if key in message_names:
            raise dbc.error(
                message.name, "",
                f"found identifier {message.frame_id:#x}, which is that of {message_names[key]}",
            )  # fmt: skip
        message_names[key] = message.name
        _check_message(dbc, message)
    return dbc


def _check_message(dbc: Dbc, message: Any) -> None:
    if message.length > 8:
        raise dbc.error(message.name, "", f"found {message.length} bytes, expected at most 8")
    for signal in message.signals:
        scale, offset = float(signal.conversion.scale), float(signal.conversion.offset)
        if scale == 0.0 or not math.isfinite(scale) or not math.isfinite(offset):
            raise dbc.error(
                message.name, signal.name,
                f"found a scale of {scale:g} and an offset of {offset:g}, expected a finite scale "
                "that is not zero",
            )  # fmt: skip
        if signal.conversion.is_float and signal.length not in FLOATS:
            raise dbc.error(
                message.name, signal.name,
                f"found a float of {signal.length} bits, expected 16, 32 or 64",
            )  # fmt: skip
    try:
        message.refresh(strict=True)
    except Exception as error:
        named = [s.name for s in message.signals if re.search(rf"\b{s.name}\b", str(error))]
        last = max(named, key=lambda name: dbc.line(message.name, name), default="")
        raise dbc.error(message.name, last, _plain(error)) from None


def _check_types(path: Path, text: str) -> None:
    """Refuse types that DBC does not define; cantools would read them as integers."""
    for number, line in enumerate(text.splitlines(), 1):
        match = _TYPE.match(line)
        if match and match[3] not in "012":
            raise ProfileError(
                f"{path}, line {number}: SIG_VALTYPE_ {match[2]}: found type {match[3]}, "
                "expected 0 (integer), 1 (32-bit float) or 2 (64-bit float)"
            )


def _lines_of(text: str) -> dict[tuple[str, str], int]:
    lines: dict[tuple[str, str], int] = {}
    message = ""
    for number, line in enumerate(text.splitlines(), 1):
        if match := _MESSAGE.match(line):
            message = match[1]
            lines.setdefault((message, ""), number)
        elif match := _SIGNAL.match(line):
            lines.setdefault((message, match[1]), number)
    return lines


def _line_in(text: str) -> int:
    match = re.search(r"line (\d+)", text)
    return int(match[1]) if match else 1


def _plain(error: BaseException) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text.removeprefix("DBC: ").strip('"')
