"""An effect is one file and one line: nothing else in the house asks for it by name."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from gapbridge.core.effects import CATALOGUE

ROOT = Path(__file__).parents[1]
OWN = ROOT / "core" / "effects"
# identifiers that are also a column of the log, a limit's key or a field of another record: as
# such they are no effect
SHARED = {"payload", "payload_cog", "joint_offset", "latency"}
# names of joints that a simulator's model is given (they stand in the user's file and in docs), and
# what the demo has put into its plant, by the name that a diagnosis must find
LABELS = {
    "bridge/patch/mjcf.py": {"backlash", "axial_compliance", "base_compliance"},
    "bridge/patch/mjcf_scene.py": {"coulomb_friction"},  # any "..._friction"
    "bridge/patch/usd.py": {"backlash", "axial_compliance"},
    "bridge/demo/hidden.py": {
        "tool_frame",
        "axial_compliance",
        "radial_compliance",
        "servo_droop",
    },
}
BEGINNINGS = tuple(f"{e}_" for e in CATALOGUE if e not in SHARED)
ASKED = {"effect", "family", "identifier"}  # attributes whose text is an identifier
PARTS = {"startswith", "endswith", "removeprefix", "removesuffix", "partition", "find", "count"}
TAKING = {"Term", "effect_named", "joints"}  # calls whose first argument is one


def _named(text: object) -> str | None:
    """Return the effect that a text is the name of, or of a parameter of."""
    if not isinstance(text, str) or " " in text:
        return None
    if text in CATALOGUE:
        return text
    if not text.startswith(BEGINNINGS):
        return None
    return next((e for e in CATALOGUE if e not in SHARED and text.startswith(f"{e}_")), None)


def _composed(node: ast.JoinedStr) -> str | None:
    """Return the effect that a formatted text can come to name: ``f"{kind}_compliance"``."""
    parts = [p.value if isinstance(p, ast.Constant) else None for p in node.values]
    if not any(isinstance(p, str) and len(p.strip("_ ")) > 5 for p in parts):
        return None
    pattern = re.compile("".join("[a-z0-9]+" if p is None else re.escape(str(p)) for p in parts))
    return next((e for e in CATALOGUE if e not in SHARED and pattern.match(f"{e}_1")), None)


def _texts(node: ast.AST) -> Iterator[str]:
    for part in ast.walk(node):
        if isinstance(part, ast.Constant) and isinstance(part.value, str):
            yield part.value


def _asked(nodes: list[ast.AST]) -> Iterator[str]:
    """Yield effects that are compared with, or asked for, by name: shared names count here."""
    for node in nodes:
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            if any(isinstance(s, ast.Attribute) and s.attr in ASKED for s in sides):
                yield from (t for s in sides for t in _texts(s) if t in CATALOGUE)
        if isinstance(node, ast.Call) and node.args:
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if name in TAKING:
                yield from (t for t in _texts(node.args[0]) if t in CATALOGUE)
        if isinstance(node, ast.Subscript) and getattr(node.value, "id", "") == "CATALOGUE":
            yield from (t for t in _texts(node.slice) if t in CATALOGUE)


def _asked_in_part(nodes: list[ast.AST]) -> Iterator[str]:
    """Yield pieces of text that an identifier is searched for: ``"compliance" in term.effect``."""
    for node in nodes:
        if isinstance(node, ast.Compare):
            sides = zip([node.left, *node.comparators], node.ops, node.comparators, strict=False)
            for left, op, right in sides:
                if isinstance(op, ast.In | ast.NotIn) and getattr(right, "attr", "") in ASKED:
                    yield from (t for t in _texts(left) if t not in CATALOGUE)
        method = getattr(node, "func", None)
        owner = getattr(getattr(method, "value", None), "attr", "")
        if isinstance(node, ast.Call) and owner in ASKED and getattr(method, "attr", "") in PARTS:
            yield from (t for argument in node.args for t in _texts(argument))


def _found(source: str) -> list[str]:
    """Return the effects that a source names, docstrings left aside."""
    nodes = list(ast.walk(ast.parse(source)))
    prose = {
        id(node.body[0].value)
        for node in nodes
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    found = [*_asked(nodes), *_asked_in_part(nodes)]
    for node in nodes:
        if isinstance(node, ast.Constant) and id(node) not in prose:
            name = _named(node.value)
            if name and name not in SHARED:
                found.append(name)
        if isinstance(node, ast.JoinedStr) and (composed := _composed(node)):
            found.append(composed)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith(
            "gapbridge.core.effects."
        ):
            name = (node.module or "").rpartition(".")[2]
            found += [name] if name in CATALOGUE else []
    return found


def test_no_effect_is_named_outside_its_own_file_and_the_table() -> None:
    sources = [p for top in ("core", "drivers", "bridge") for p in (ROOT / top).rglob("*.py")]
    assert len(sources) > 100
    named = {
        f"{path.relative_to(ROOT)}: {name}"
        for path in sources
        if OWN not in path.parents
        for name in _found(path.read_text(encoding="utf-8"))
        if name not in LABELS.get(path.relative_to(ROOT).as_posix(), set())
    }
    assert named == set()


def test_the_search_finds_what_it_looks_for() -> None:
    assert _found('x = ("backlash", 1)') == ["backlash"]
    assert _found('x = "ft_bias_fx"') == ["ft_bias"]
    assert _found('x = f"{kind}_compliance_{i}"') == ["axial_compliance"]
    assert _found('if term.effect == "payload": pass') == ["payload"]
    assert _found('kept = [t for t in terms if t.effect not in ("payload",)]') == ["payload"]
    assert _found('x = [t for t in terms if "compliance" not in t.effect]') == ["compliance"]
    assert _found('if term.effect.endswith(("_friction",)): pass') == ["_friction"]
    assert _found("from gapbridge.core.effects.position.backlash import Backlash") == ["backlash"]
    assert _found('"""What ``backlash`` is."""\nlog.get("payload")') == []
