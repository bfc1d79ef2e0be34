"""The results as tables, between the marks of their pages; nothing else of a page changes.

docs/reliability.md has a line a fault, docs/evidence/faults.md a line a fault and link.
"""

from __future__ import annotations

import statistics
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.faults.row import Result, Row

DOCS = Path(__file__).parents[2] / "docs"
PAGE, EVERY_LINK = DOCS / "reliability.md", DOCS / "evidence" / "faults.md"
NOTHING = "nothing to detect"


def fill(page: Path, mark: str, text: str) -> None:
    """Put ``text`` between the marks of a page. Raises ValueError where it has none."""
    begin, end = f"<!-- {mark}: begin -->", f"<!-- {mark}: end -->"
    before, found, rest = page.read_text(encoding="utf-8").partition(begin)
    _, ended, after = rest.partition(end)
    if not (found and ended):
        raise ValueError(f"{page}: found no marks of {mark!r}")
    page.write_text(f"{before}{begin}\n{text}\n{end}{after}", encoding="utf-8")


def fill_matrix(rows: Sequence[Row], results: Sequence[Result]) -> None:
    """Put the matrix of faults into both pages."""
    fill(PAGE, "matrix", matrix(rows, results))
    fill(EVERY_LINK, "matrix", matrix_by_link(rows, results))


def matrix(rows: Iterable[Row], results: Sequence[Result]) -> str:
    """Return the matrix of faults, a line for each row: the worst over its links."""
    lines = [
        "| fault: how it is made | links | times | detected after, at worst, cycles (ms) "
        "| largest step / a cycle's allowance | not as expected |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        found = [r for r in results if r.row == row.key]
        if found:
            lines.append(_worst_line(row, found))
    return "\n".join([*lines, "", counted(results)])


def _worst_line(row: Row, found: Sequence[Result]) -> str:
    seen = [r for r in found if r.judged and r.cycles is not None and row.sign != "none"]
    detected = NOTHING if row.sign == "none" else "-"
    if seen:
        cycles = max(r.cycles or 0.0 for r in seen)
        detected = f"{cycles:.1f} ({1e3 * max(r.detected or 0.0 for r in seen):.0f})"
    step = max(r.largest_step / r.step_allowed for r in found if r.step_allowed)
    return (
        f"| {row.fault}: {row.how} | {len({r.link for r in found})} | {len(found)} | {detected} | "
        f"{step:.1f} | {_verdict(found)} |"
    )


def matrix_by_link(rows: Iterable[Row], results: Sequence[Result]) -> str:
    """Return the matrix of faults, a line for each row and link."""
    by_case: dict[tuple[str, str], list[Result]] = defaultdict(list)
    for result in results:
        by_case[result.row, result.link].append(result)
    lines = [
        "| fault | how it is made | link | times | detected after, cycles: median, worst (ms) "
        "| largest step, µm (one cycle's allowance) | end | not as expected |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for row in rows:
        for (key, link), found in by_case.items():
            if key == row.key:
                lines.append(_line(row, link, found))
    return "\n".join([*lines, "", counted(results)])


def counted(results: Sequence[Result]) -> str:
    """Return in a sentence how many faults were made, and how many were not as expected."""
    broken = sum(r.violated for r in results)
    found = (
        f"{len(results)} faults made, each once, {_wrong(results)} not as expected, {broken} with "
        "an invariant broken"
    )
    if unjudged := [r.late for r in results if not r.judged]:
        late = f"up to {1e3 * max(unjudged):.0f} ms"
        found += f"; {len(unjudged)} not judged, because the machine itself was late by {late}"
    return f"{found}."


def _wrong(results: Sequence[Result]) -> int:
    return sum(bool(r.wrong and r.judged) for r in results)


def _verdict(found: Sequence[Result]) -> str:
    """Return how many were not as expected, and how many were not judged where some were not."""
    unjudged = sum(not r.judged for r in found)
    return f"{_wrong(found) or 'none'}" + (f", {unjudged} not judged" if unjudged else "")


def _line(row: Row, link: str, found: Sequence[Result]) -> str:
    judged = [r for r in found if r.judged]
    cycles = [r.cycles for r in judged if r.cycles is not None and row.sign != "none"]
    detected = NOTHING if row.sign == "none" else "-"
    if cycles:
        worst = max(r.detected or 0.0 for r in judged)
        detected = f"{statistics.median(cycles):.1f}, {max(cycles):.1f} ({1e3 * worst:.0f})"
    step = 1e6 * max(r.largest_step for r in found)
    ends = ", ".join(
        f"{end} {count}" if len({r.end for r in judged}) > 1 else end
        for end, count in Counter(r.end for r in judged).most_common()
    )
    allowed = 1e6 * found[0].step_allowed
    return (
        f"| {row.fault} | {row.how} | {link} | {len(found)} | {detected} | "
        f"{step:.0f} ({allowed:.0f}) | {ends or '-'} | {_verdict(found)} |"
    )
