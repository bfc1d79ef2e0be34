"""What a table names, a module's member or a text of a file, is where the table says."""

from __future__ import annotations

import ast
import functools
import importlib
from pathlib import Path

import pytest

from benchmarks.mutants.mutant import Mutant, read_mutants
from gapbridge.bridge.cell.simulation import SIMULATORS
from gapbridge.bridge.cli.table import COMMANDS
from gapbridge.bridge.daemon.side_processes import SIDE_PROCESSES
from gapbridge.bridge.setpoint_source import SOURCES
from gapbridge.drivers import DRIVERS
from gapbridge.drivers.ft_sensor import FT_SENSORS

ROOT = Path(__file__).parents[1]
NAMED = [
    *SIMULATORS.values(),
    *(name for name, _ in COMMANDS.values()),
    *SOURCES.values(),
    *DRIVERS.values(),
    *FT_SENSORS.values(),
]


@pytest.mark.parametrize("name", NAMED)
def test_a_named_member_is_where_its_table_says(name: str) -> None:
    module, member = name.split(":")
    assert callable(getattr(importlib.import_module(module), member))


@pytest.mark.parametrize("name", [module for module, _ in SIDE_PROCESSES.values()])
def test_a_side_process_is_a_module_that_can_be_run(name: str) -> None:
    file = importlib.import_module(name).__file__
    assert file is not None
    assert 'if __name__ == "__main__":\n' in Path(file).read_text(encoding="utf-8")


@pytest.mark.parametrize("mutant", read_mutants(), ids=lambda m: m.what)
def test_a_listed_mistake_can_be_made_and_names_tests_that_are_there(mutant: Mutant) -> None:
    text = mutant.text(ROOT)
    if mutant.file.endswith(".py"):
        ast.parse(text)
    assert text != (ROOT / mutant.file).read_text(encoding="utf-8")
    for test in mutant.tests:
        path, _, name = test.partition("::")
        files = [ROOT / path] if path.endswith(".py") else (ROOT / path).rglob("test_*.py")
        found = set().union(*(quick_tests(file) for file in files))
        assert name in found if name else found, test


@functools.cache
def quick_tests(file: Path) -> frozenset[str]:
    """Return the names of a file's tests that ``make test`` runs."""
    body = ast.parse(file.read_text(encoding="utf-8")).body
    marks = [node for node in body if isinstance(node, ast.Assign) and is_slow(node)]
    names = [
        node.name
        for node in body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
        if not any(is_slow(decorator) for decorator in node.decorator_list)
    ]
    return frozenset() if marks else frozenset(names)


def is_slow(node: ast.AST) -> bool:
    """Return whether a decorator, or the marks of a file, say slow."""
    if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) != "pytestmark":
        return False
    return any(ast.unparse(n) == "pytest.mark.slow" for n in ast.walk(node))


def test_a_test_is_quick_where_neither_it_nor_its_file_is_marked(tmp_path: Path) -> None:
    slow = "@pytest.mark.slow\ndef test_a(): ...\ndef test_b(): ...\ndef other(): ...\n"
    for name, text, expected in (
        ("one.py", slow, {"test_b"}),
        ("other.py", "pytestmark = [pytest.mark.slow]\n" + slow, set()),
    ):
        (tmp_path / name).write_text(text)
        assert quick_tests(tmp_path / name) == expected
