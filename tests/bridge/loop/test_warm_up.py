"""After the warm-up of an installation no command has anything left to compile."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from numba.core.dispatcher import Dispatcher

from gapbridge.bridge.loop.warm_up import warm_up
from gapbridge.core.kernels.machine_code import MARK, OURS


def modules() -> list[ModuleType]:
    """Return the modules with compiled functions."""
    found = []
    for folder in OURS:
        root = folder.parent
        for file in folder.rglob("*.py"):
            if MARK in file.read_bytes() and file.name != "machine_code.py":
                name = ".".join(file.relative_to(root).with_suffix("").parts)
                found.append(import_module(f"gapbridge.{name}"))
    return found


def test_each_function_that_python_calls_is_compiled_by_the_warm_up() -> None:
    functions = {
        id(value): value
        for module in modules() for value in vars(module).values() if isinstance(value, Dispatcher)
    }  # fmt: skip
    within = {
        id(function.py_func.__globals__.get(name))
        for function in functions.values() for name in function.py_func.__code__.co_names
    }  # fmt: skip
    warm_up()
    called = [functions[key] for key in functions.keys() - within]
    assert len(called) > 20
    assert [function.py_func.__qualname__ for function in called if not function.signatures] == []
