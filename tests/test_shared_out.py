"""Files are shared out whole, and those that mostly wait to two processes only.

The simulated runs are shared out one by one.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from waiting import COMPUTE, WAIT, WAITING, waits

pytest.importorskip("xdist")

from shared_out import ONE_BY_ONE, Scheduling

HERE = Path(__file__).parent


class Node:
    """A process of xdist that has run each test by the time it is asked for the next."""

    def __init__(self, number: int) -> None:
        self.gateway = SimpleNamespace(id=f"gw{number}")
        self.sent: list[int] = []
        self.shutting_down = False

    def send_runtest_some(self, indices: list[int]) -> None:
        self.sent += indices

    def shutdown(self) -> None:
        self.shutting_down = True


def shared_out(tests: list[str], processes: int) -> dict[str, list[str]]:
    """Return which tests each process has run, in their order."""
    option = SimpleNamespace(loadscopereorder=True)
    config: Any = SimpleNamespace(getvalue=lambda _: ["popen"] * processes, option=option)
    scheduling = Scheduling(config)
    nodes = [Node(i) for i in range(processes)]
    for node in nodes:
        scheduling.add_node(node)
    for node in nodes:
        scheduling.add_node_collection(node, tests)
    scheduling.schedule()
    done = Counter[str]()
    while scheduling.has_pending:
        before = done.total()
        for node in nodes:
            name = node.gateway.id
            if done[name] < len(node.sent):
                scheduling.mark_test_complete(node, node.sent[done[name]])
                done[name] += 1
        assert done.total() > before, "tests are left that nobody runs"
    return {node.gateway.id: [tests[i] for i in node.sent] for node in nodes}


@pytest.mark.parametrize("processes", [2, 4])
def test_files_stay_whole_and_those_that_wait_go_to_two_processes(processes: int) -> None:
    files = ["bridge/web/test_a.py", "drivers/can/test_b.py", "hil/test_c.py"]
    files += [f"core/test_{i}.py" for i in range(8)]
    tests = [f"tests/{file}::test_{i}" for file in files for i in range(5)]
    found = shared_out(tests, processes)
    assert sorted(test for ran in found.values() for test in ran) == sorted(tests)
    where = {(test.split("::")[0], name) for name, ran in found.items() for test in ran}
    assert len(where) == len(files)
    assert {name for file, name in where if waits(file)} <= {*WAITING}
    for name, ran in found.items():  # who waits takes others only when nothing else is left
        kinds = [waits(test) for test in ran]
        assert kinds == sorted(kinds, reverse=True) if name in WAITING else not any(kinds)


def test_long_cases_are_shared_out_one_by_one_and_last() -> None:
    files = ["bridge/web/test_a.py", "core/test_b.py", "core/test_c.py"]
    others = [f"tests/{file}::test_{i}" for file in files for i in range(5)]
    runs = [f"{ONE_BY_ONE}_holds[{i}]" for i in range(40)]
    found = shared_out(runs + others, 4)
    assert sorted(test for ran in found.values() for test in ran) == sorted(runs + others)
    for ran in found.values():
        kinds = [test in runs for test in ran]
        assert kinds == sorted(kinds)
        assert 5 <= sum(kinds) <= 15
    file, name = ONE_BY_ONE.split("::")
    assert f"def {name}" in (HERE.parent / file).read_text(encoding="utf-8")


def test_every_file_that_waits_is_there() -> None:
    assert [place for place in (*WAIT, *COMPUTE) if not (HERE / place).exists()] == []
