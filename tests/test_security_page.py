"""Each test that SECURITY.md names is there: a sentence about safety is one that a test shows."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NAMED = sorted(set(re.findall(r"`(test_\w+)`", (ROOT / "SECURITY.md").read_text(encoding="utf-8"))))
KNOWN = {
    name
    for path in (ROOT / "tests").rglob("test_*.py")
    for name in re.findall(r"^def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
}


@pytest.mark.parametrize("name", NAMED)
def test_a_test_that_the_page_names_is_there(name: str) -> None:
    assert name in KNOWN


def test_each_point_on_what_listens_and_what_leaves_names_its_test() -> None:
    page = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    for title in ("What the daemon listens on", "What is sent to the robot"):
        section = page.split(f"\n## {title}\n")[1].split("\n## ")[0]
        points = re.split(r"^- ", section, flags=re.MULTILINE)[1:]
        assert len(points) > 5
        for point in points:
            assert re.search(r"`test_\w+`", point), point
