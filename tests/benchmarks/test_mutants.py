"""The list of mistakes: each stands in a file of the product as it is, and a test notices it."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import pytest

from benchmarks.mutants.__main__ import noticed_in, table
from benchmarks.mutants.mutant import Mutant, read_mutants
from benchmarks.mutants.trial import Verdict
from gapbridge.core.errors import InputError

ROOT = Path(__file__).resolve().parents[2]
MUTANTS = read_mutants()


def test_no_mistake_stands_in_the_list_twice() -> None:
    seen = {(m.file, m.find, m.replace) for m in MUTANTS}
    assert len(seen) == len(MUTANTS)


def test_a_text_that_is_not_there_once_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text("x = 1\nx = 1\n")
    with pytest.raises(InputError, match="2 times, expected once"):
        Mutant("twice", "a.py", "x = 1", "x = 2", ("tests",)).text(tmp_path)


def test_the_table_counts_by_folder() -> None:
    files = ("core/a.py", "core/effects/load/a.py", "core/effects/a.py", "bridge/loop/a.py")
    mutants = [Mutant("m", file, "x", "y", ("tests",)) for file in files]
    lines = table([Verdict(m, m is not mutants[1], "") for m in mutants])
    assert lines[2:] == [
        "| bridge/loop | 1 | 1 (100 %) |",
        "| core | 1 | 1 (100 %) |",
        "| core/effects | 2 | 1 (50 %) |",
        "| all | 4 | 3 (75 %) |",
    ]


def test_a_run_goes_on_with_what_was_noticed_before(tmp_path: Path) -> None:
    mutants = [Mutant("m", "core/a.py", "x", str(i), ("tests",)) for i in range(3)]
    verdicts = [Verdict(mutants[0], True, "FAILED one"), Verdict(mutants[1], False, "2 passed")]
    out = tmp_path / "out.jsonl"
    assert noticed_in(out, mutants) == []
    out.write_text("".join(json.dumps(asdict(v)) + "\n" for v in verdicts), encoding="utf-8")
    assert noticed_in(out, mutants) == verdicts[:1]
    assert noticed_in(out, mutants[1:]) == []  # its text or its tests are others now
