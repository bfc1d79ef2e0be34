"""Two checkouts side by side do not meet: what one process has, no other gets."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from ports import free_port, own_host

from benchmarks import ports

HERE = Path(__file__).parent
OTHER = """
import sys
from benchmarks.ports import own_host
print(own_host(), flush=True)
sys.stdin.read()
"""


def test_an_address_that_another_process_has_is_not_given_away(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", OTHER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        theirs = other.stdout.readline().rpartition(".")[0]
        second, third = map(int, theirs.split(".")[1:])
        drawn = iter([second - 100, third, *(n for k in range(100) for n in (k, 255))])
        monkeypatch.setattr(ports.secrets, "randbelow", lambda _: next(drawn))
        monkeypatch.setattr(ports, "_hosts", [])
        assert own_host().rpartition(".")[0] != theirs
        other.communicate("")


def test_an_address_is_given_away_once() -> None:
    assert len({own_host() for _ in range(600)}) == 600


def test_a_port_is_given_away_once(monkeypatch: pytest.MonkeyPatch) -> None:
    first = free_port()
    drawn = iter([first, *range(11_000, 12_000)])
    monkeypatch.setattr(ports.secrets, "choice", lambda _: next(drawn))
    assert free_port() != first


def test_no_test_makes_an_address_of_its_own() -> None:
    for path in HERE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r'f"127\.[{]', text), f"{path}: expected own_host() of ports.py"
