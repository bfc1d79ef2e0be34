"""No module reads the time by itself: it takes a Clock, except at the edges that pyproject lists.

ruff checks the same list (TID251), only in ``make check``. It looks at names: it shows neither who
makes a clock of the system's time nor who waits for an event without one.
"""

from __future__ import annotations

import ast
import re
import tomllib
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LINT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["ruff"]["lint"]
BANNED = set(LINT["flake8-tidy-imports"]["banned-api"])
SYSTEM = "gapbridge.drivers.clock.SYSTEM"
MADE = "gapbridge.drivers.clock.Clock"  # called, it is a clock of the system's time
EVENT = "threading.Event"
PUBLIC = "make_driver"  # has a default, for users; within the product its clock is given
IMPORTS = re.compile(r"(import|from) (time|datetime|threading|asyncio)|drivers(\.clock| import)")
TOPS = ("core", "drivers", "bridge")


def edges() -> dict[str, set[str]]:
    """Return what each pattern of exceptions lists: files below ROOT."""
    found = {}
    for pattern, rules in LINT["per-file-ignores"].items():
        if "TID251" in rules and pattern.startswith(TOPS):
            files = {path for one in braces(pattern) for path in ROOT.glob(one)}
            found[pattern] = {str(path.relative_to(ROOT)) for path in files}
    return found


def braces(pattern: str) -> list[str]:
    """Return the patterns that one with ``{a,b}`` stands for; pathlib has no braces."""
    parts = [part.split(",") for part in re.split(r"[{}]", pattern)]
    return ["".join(chosen) for chosen in product(*parts)]


def reads(text: str) -> list[tuple[int, str]]:
    """Return where a module reads the time or waits without a Clock: line, what."""
    if not IMPORTS.search(text):
        return []  # parsing all sources takes seconds
    tree = ast.parse(text)
    names = dict(imported(tree))
    events = set(named_events(tree, names))

    def full(node: ast.AST) -> str:
        """Return the dotted name of what was imported; empty: something else."""
        first, dot, rest = dotted(node).partition(".")
        return names[first] + dot + rest if first in names else ""

    found = []
    for node in ast.walk(tree):
        if isinstance(node, (ast.Name, ast.Attribute)) and full(node) in BANNED:
            found.append((node.lineno, full(node)))
        elif isinstance(node, ast.Call):
            called = full(node.func)
            owner, _, method = dotted(node.func).rpartition(".")
            timed = bool(node.args or node.keywords)
            if called == MADE or (method == "wait" and timed and owner.split(".")[-1] in events):
                found.append((node.lineno, called))
            keys = {keyword.arg for keyword in node.keywords}
            if called == f"gapbridge.drivers.{PUBLIC}" and not ("clock" in keys or node.args[3:]):
                found.append((node.lineno, f"{PUBLIC} without a clock"))
    return found


def dotted(node: ast.AST) -> str:
    """Return ``a.b.c`` of such an expression; empty for any other (many times ast.unparse)."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        owner = dotted(node.value)
        return owner and f"{owner}.{node.attr}"
    return ""


def imported(tree: ast.AST) -> Iterator[tuple[str, str]]:
    """Yield each name that a module imports, and what it stands for."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield (alias.asname, alias.name) if alias.asname else (alias.name,) * 2
        elif isinstance(node, ast.ImportFrom):
            for alias in node.names:
                yield alias.asname or alias.name, f"{node.module}.{alias.name}"


def named_events(tree: ast.AST, names: dict[str, str]) -> Iterator[str]:
    """Yield the names of a module's events: what one is assigned to, or is annotated as one."""
    short = {name for name, meant in names.items() if meant == EVENT} | {EVENT}
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call):
            if dotted(node.value.func) in short:
                yield from (dotted(target).split(".")[-1] for target in node.targets)
        elif isinstance(node, ast.arg) and node.annotation and dotted(node.annotation) in short:
            yield node.arg


def test_only_the_listed_edges_read_the_time_or_name_the_systems_clock() -> None:
    allowed = set().union(*edges().values())
    found = [
        (file, line, what)
        for top in TOPS
        for path in (ROOT / top).rglob("*.py")
        if (file := str(path.relative_to(ROOT))) not in allowed
        for line, what in reads(path.read_text(encoding="utf-8"))
    ]
    assert not found, "take a Clock as an argument (drivers/clock.py)"


@pytest.mark.parametrize("pattern", edges())
def test_a_listed_edge_still_needs_to_be_listed(pattern: str) -> None:
    files = edges()[pattern]
    assert files, "found no such file"
    assert [f for f in files if not reads((ROOT / f).read_text(encoding="utf-8"))] == []


def test_entry_points_only_hand_the_systems_clock_on() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    start = text.index("# entry points")
    listed = [f for pattern, files in edges().items() if text.index(pattern) > start for f in files]
    assert listed
    for file in listed:
        found = {what for _, what in reads((ROOT / file).read_text(encoding="utf-8"))}
        assert found == {SYSTEM}, file


@pytest.mark.parametrize(
    "planted",
    [
        "import time\n\nstart = time.monotonic()",
        "import time as t\n\nnow = t.perf_counter_ns",
        "from time import sleep\n\nsleep(1.0)",
        "def late():\n    from time import time\n    return time()",
        "from datetime import UTC, datetime\n\nnow = datetime.now(UTC)",
        "import datetime\n\ntoday = datetime.date.today()",
        "import time\n\nname = time.strftime('%Y')",
        "from gapbridge.drivers.clock import SYSTEM, Clock\n\ndef f(clock: Clock = SYSTEM): ...",
        "from gapbridge.drivers import clock\n\nnow = clock.SYSTEM.time()",
        "from gapbridge.drivers.clock import Clock\n\nnow = Clock().time()",
        "import threading\n\nover = threading.Event()\nover.wait(0.1)",
        "from threading import Event\n\ndef f(over: Event): return over.wait(timeout=1.0)",
        "from gapbridge.drivers import make_driver\n\nmake_driver(settings, model)",
    ],
)
def test_a_planted_read_is_found(planted: str) -> None:
    assert reads(planted)


def test_what_takes_a_clock_is_not_found() -> None:
    taken = (
        "import threading\nfrom datetime import datetime\n"
        "from gapbridge.drivers import make_driver\nfrom gapbridge.drivers.clock import Clock\n\n"
        "def f(clock: Clock, over: threading.Event, time):\n"
        "    clock.sleep(clock.time())\n    clock.wait(over, 1.0)\n    over.wait()\n"
        "    make_driver(settings, model, clock=clock)\n    time.sleep(2.0)\n"
        "    return datetime.fromtimestamp(clock.time())\n"
    )
    assert reads(taken) == []
