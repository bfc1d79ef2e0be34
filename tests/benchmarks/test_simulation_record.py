"""``make simulate``: what has run is not run again, and what did not hold is reported again."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from benchmarks.simulation import __main__ as many
from benchmarks.simulation.invariants import Violation
from benchmarks.simulation.sequence import Outcome


def part(first: int, end: int, **more: Any) -> dict[str, Any]:
    return {"first": first, "end": end, "violated": {}, **more}


def test_only_seeds_without_a_line_are_run() -> None:
    done = [part(100, 200), part(250, 260)]
    left = [*many.missing(0, 320, done)]
    assert left == [range(100), range(200, 250), range(260, 320)]
    assert [*many.missing(0, 250, [])] == [range(100), range(100, 200), range(200, 250)]
    assert [*many.missing(100, 200, done)] == []


@pytest.mark.parametrize(("now", "kept"), [("abc", [0]), ("def", [])], ids=str)
def test_lines_of_other_sources_count_for_nothing(
    tmp_path: Path, now: str, kept: list[int]
) -> None:
    path = tmp_path / "out" / "record.jsonl"
    many.Record(path, "abc").add(part(0, 100))
    assert [found["first"] for found in many.Record(path, now).parts] == kept


SOURCES = """
from benchmarks.simulation import __main__ as many
from pathlib import Path
import sys
loaded = set(sys.modules)
before = many.sources()
for seed in range(4):
    many.run(seed)
assert not {n for n in set(sys.modules) - loaded if n.startswith(("gapbridge", "benchmarks"))}
read, changed = Path.read_bytes, set(sys.argv[1:])
Path.read_bytes = lambda path: b"changed" if path.name in changed else read(path)
print(before == many.sources())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "counts"), [("writing.py", False), ("judgement.py", True)], ids=str
)
def test_what_has_run_counts_until_a_source_that_runs_changes(changed: str, counts: bool) -> None:
    ran = subprocess.run(
        [sys.executable, "-c", SOURCES, changed], cwd=many.ROOT, capture_output=True, text=True
    )
    assert ran.stdout.split() == [str(counts)], ran.stderr


def test_a_run_goes_on_where_it_was_left_and_reports_what_did_not_hold(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ran: list[int] = []

    def run(seed: int) -> Outcome:
        ran.append(seed)
        wrong = [Violation("rate", 1.0, "a step")] if seed == 7 else []
        return Outcome(seed, "can", ["loop dies (3 lines on) at 0.9 s"], wrong, writes=2)

    class Pool:
        def __init__(self, *_: Any, **__: Any) -> None: ...

        def __enter__(self) -> Pool:
            return self

        def __exit__(self, *_: object) -> None: ...

        imap_unordered = staticmethod(map)

    monkeypatch.setattr(many, "run", run)
    monkeypatch.setattr(many, "sources", lambda: "abc")
    monkeypatch.setattr(many.multiprocessing, "Pool", Pool)
    out = tmp_path / "record.jsonl"

    def command(seeds: int) -> tuple[int, dict[str, Any], str]:
        monkeypatch.setattr("sys.argv", ["-", "--seeds", str(seeds), "--out", str(out)])
        code = many.main()
        words = capsys.readouterr().out
        return code, json.loads(words.splitlines()[-1]), words

    code, figures, words = command(100)
    assert code == 1 and figures["violated"] == 1
    assert "rate at 1.0000 s: a step" in words and "--seed 7\n" in words
    code, figures, words = command(150)
    assert code == 1 and "--seed 7\n" in words
    assert ran == [*range(150)]
    assert figures["seeds"] == 150 and figures["setpoints"] == 300
    assert figures["by_fault"] == {"loop dies": 150} and figures["by_link"] == {"can": 150}
    code, figures, words = command(5)
    assert code == 0 and figures["seeds"] == 5  # none of whose lines has seed 7
