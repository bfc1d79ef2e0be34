"""Parsing URScript text: programs from a byte stream, and single calls from a line.

Only what clients upload is understood: straight lines of calls with numbers. Source: the URScript
manual for the forms of calls.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

_HEAD = re.compile(r"^(def|sec)\s+([A-Za-z_]\w*)\s*\(")


class Pose(tuple[float, ...]):
    """A URScript pose, p[x, y, z, rx, ry, rz]."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class ScriptText:
    """One program as it was uploaded: its kind (def, sec, or line), name and lines of the body."""

    kind: str
    name: str
    lines: tuple[str, ...]


def take_script(buffer: bytearray) -> ScriptText | None:
    """Remove and return the first whole program of `buffer`; None if incomplete.

    A program runs from a `def` or `sec` in the first column to an `end` in the first column. Any
    other line in the first column is a program of its own.
    """
    while b"\n" in buffer:
        text = buffer.decode("latin-1")
        lines = text.split("\n")
        first = lines[0].rstrip()
        head = _HEAD.match(first)
        if head is None:
            del buffer[: buffer.index(b"\n") + 1]
            if first.strip() and not first.lstrip().startswith("#"):
                return ScriptText("line", first.strip(), (first.strip(),))
            continue
        for i, line in enumerate(lines[1:-1], start=1):
            if line.rstrip() == "end":
                used = len("\n".join(lines[: i + 1])) + 1
                del buffer[:used]
                return ScriptText(head[1], head[2], tuple(lines[1:i]))
        return None
    return None


@dataclass(frozen=True, slots=True)
class Call:
    """A call found in a line."""

    name: str
    arguments: tuple[Any, ...]
    named: Mapping[str, Any]

    def get(self, position: int, name: str, default: Any) -> Any:
        """Return an argument by place or by name."""
        if position < len(self.arguments):
            return self.arguments[position]
        return self.named.get(name, default)


def parse_call(line: str, names: Mapping[str, Any] | None = None) -> Call | None:
    """Return the call that a line consists of; None for anything else.

    `names` are values of variables that the arguments may use.
    """
    try:
        node = ast.parse(line.strip(), mode="eval").body
        if not isinstance(node, ast.Call) or not isinstance(node.func, ast.Name):
            return None
        return Call(
            node.func.id,
            tuple(_value(a, names or {}) for a in node.args),
            {k.arg: _value(k.value, names or {}) for k in node.keywords if k.arg},
        )
    except (SyntaxError, ValueError, TypeError, ZeroDivisionError):
        return None


def parse_assignment(line: str, names: Mapping[str, Any]) -> tuple[str, Any] | None:
    """Return (name, value) of a line that assigns numbers, lists or poses; None for others."""
    try:
        body = ast.parse(re.sub(r"^\s*(global|local)\s+", "", line).strip()).body
        if len(body) != 1 or not isinstance(body[0], ast.Assign):
            return None
        target = body[0].targets[0]
        if not isinstance(target, ast.Name):
            return None
        return target.id, _value(body[0].value, names)
    except (SyntaxError, ValueError, TypeError, ZeroDivisionError):
        return None


_FUNCTIONS = {"d2r": math.radians, "r2d": math.degrees, "sqrt": math.sqrt}


def _value(node: ast.expr, names: Mapping[str, Any]) -> Any:
    """Return the value of an expression of numbers; raises ValueError for anything else."""
    if isinstance(node, ast.Constant):
        return node.value
    if isinstance(node, ast.Name) and node.id in names:
        return names[node.id]
    if isinstance(node, ast.List | ast.Tuple):
        return tuple(_value(e, names) for e in node.elts)
    if (
        isinstance(node, ast.Subscript)
        and isinstance(node.value, ast.Name)
        and node.value.id == "p"
    ):
        return Pose(_value(node.slice, names))
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return -_value(node.operand, names)
    if isinstance(node, ast.BinOp):
        return _binary(node, names)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        function = _FUNCTIONS.get(node.func.id)
        if function is not None and len(node.args) == 1:
            return function(_value(node.args[0], names))
    raise ValueError(ast.dump(node))


def _binary(node: ast.BinOp, names: Mapping[str, Any]) -> Any:
    left, right = _value(node.left, names), _value(node.right, names)
    if isinstance(node.op, ast.Add):
        return left + right
    if isinstance(node.op, ast.Sub):
        return left - right
    if isinstance(node.op, ast.Mult):
        return left * right
    if isinstance(node.op, ast.Div):
        return left / right
    raise ValueError(ast.dump(node))
