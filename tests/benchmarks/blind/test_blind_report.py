import io
import re

import pytest
from rich.console import Console

from benchmarks.blind.page import write_page
from benchmarks.blind.report import print_report
from benchmarks.blind.score import CaseScore
from benchmarks.blind.tally import by_kind, criteria, matrix


def a_score(kind="backlash", group="known", outcome="right", named=None, **more):
    put_in = () if kind == "none" else (kind.rpartition(":")[2],)
    named = put_in if named is None else named
    return CaseScore(kind, group, 1, "cobot5", "position", put_in, named, outcome, **more)


SCORES = [
    *(a_score(joints_right=True, remainder=1.02, z={"backlash_2": 0.3}, seconds=1.0),) * 3,
    a_score(outcome="wrong", named=("joint_offset", "backlash"), false=("joint_offset",)),
    *(a_score("none", "clean", named=(), seconds=1.5),) * 2,
    a_score("outside:hose", "outside", named=(), admitted=True, depends_right=True),
    a_score("withheld:payload", "withheld", "missed", named=(), depends_right=False),
]


def test_the_figures_are_shares_of_their_own_cases():
    found = {c.name.split(":")[0]: c for c in criteria(SCORES)}
    assert found["one effect"].value == pytest.approx(0.75)
    assert found["one effect"].reached is False
    assert found["clean data"].reached is True
    assert found["outside the catalogue"].value == 1.0
    assert found["withheld"].value == 0.0
    assert found["two or three effects"].reached is None
    remainder = found["held-out error over the noise floor, median"]
    assert (remainder.value, remainder.reached) == (pytest.approx(1.02), True)


def test_a_case_with_two_names_is_shared_between_them():
    _, columns, cells = matrix(SCORES)
    assert cells["backlash"] == {"backlash": 3.5, "joint_offset": 0.5}
    assert cells["none"] == {"none": 2}
    assert cells["not in the catalogue: hose"] == {"not in the catalogue": 1}
    assert cells["withheld:payload"] == {"none": 1}
    assert columns[-2:] == ["none", "not in the catalogue"]


def test_kinds_are_added_up():
    backlash = by_kind(SCORES)[0]
    assert (backlash.cases, backlash.right, backlash.false) == (4, 3, 1)


def test_the_tables_say_what_is_reached():
    out = io.StringIO()
    print_report(SCORES, Console(file=out, width=160))
    text = out.getvalue()
    assert re.search(r"one effect.*75\.0 %.*not reached", text)
    assert "joint_offset 0.5" in text


def test_the_page_needs_nothing_else_and_escapes_what_was_reported(tmp_path):
    scores = [*SCORES, a_score(outcome="failed", named=(), message="<script>alert(1)</script>")]
    write_page(tmp_path / "blind.html", scores, "A run")
    text = (tmp_path / "blind.html").read_text(encoding="utf-8")
    assert "not reached" in text
    assert "<script" not in text
    assert not re.search(r"(src|href)\s*=", text)
    assert text.count("<svg") == 3
