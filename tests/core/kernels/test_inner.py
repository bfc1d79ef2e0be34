"""What is compiled for other compiled functions alone is called by nothing else."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from gapbridge.core.kernels.machine_code import CORE

KERNELS = CORE / "kernels"
FOLDERS = ("core", "drivers", "bridge", "tests", "benchmarks")
WITHIN = ("INNER", "FAST", "SUMS")


def _compiled(tree: ast.Module) -> dict[str, ast.FunctionDef]:
    """Return the compiled functions of a file by name."""
    functions = (n for n in tree.body if isinstance(n, ast.FunctionDef) and n.decorator_list)
    return {f.name: f for f in functions if "njit" in ast.unparse(f.decorator_list[0])}


def _is_inner(function: ast.FunctionDef) -> bool:
    return any(f"**{name})" in ast.unparse(function.decorator_list[0]) for name in WITHIN)


def _called(file: Path, tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield module and name of what is named outside compiled functions, of the kernels'."""
    compiled = _compiled(tree)
    names = {name: (file.stem, name) for name in compiled} if file.parent == KERNELS else {}
    modules = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and "core.kernels" in (node.module or ""):
            last = (node.module or "").split(".")[-1]
            for alias in node.names:
                if last == "kernels":
                    modules[alias.asname or alias.name] = alias.name
                else:
                    names[alias.asname or alias.name] = (last, alias.name)
    within = {id(node) for function in compiled.values() for node in ast.walk(function)}
    for node in ast.walk(tree):
        if id(node) in within:
            continue
        if isinstance(node, ast.Name) and node.id in names:
            yield names[node.id]
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            yield modules.get(node.value.id, ""), node.attr


def test_what_only_compiled_functions_call_is_called_by_no_other() -> None:
    """Python has nothing to call it by: the call would end the process."""
    files = [file for folder in FOLDERS for file in (CORE.parent / folder).rglob("*.py")]
    texts = {file: file.read_text(encoding="utf-8") for file in files}
    trees = {file: ast.parse(text) for file, text in texts.items() if "kernels" in text}
    inner = {
        (file.stem, name)
        for file in trees
        if file.parent == KERNELS
        for name, function in _compiled(trees[file]).items()
        if _is_inner(function)
    }
    assert ("mechanics", "place_joint") in inner
    assert not inner & {named for file, tree in trees.items() for named in _called(file, tree)}
