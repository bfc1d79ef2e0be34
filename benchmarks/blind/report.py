"""Reports the outcome of the blind benchmark: tables for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.table import Table

from benchmarks.blind.score import CaseScore
from benchmarks.blind.sensitivity import Sensitivity
from benchmarks.blind.tally import by_kind, criteria, matrix


def print_report(scores: Sequence[CaseScore], console: Console | None = None) -> None:
    """Print the figures, the kinds, the confusion matrix and what went wrong."""
    console = console or Console(emoji=False)  # else :wrench: of a case's name becomes a picture
    if not console.is_terminal:
        console.width = max(console.width, 150)
    console.print(_kinds(scores))
    console.print(_matrix(scores))
    wrong = [s for s in scores if not s.ok]
    if wrong:
        console.print(_wrong(wrong))
    console.print(_criteria(scores))


def print_sensitivity(found: Sequence[Sensitivity], console: Console) -> None:
    """Print how small each effect may be and still be found."""
    table = Table(title="Smallest effect found in 95 % of cases: gap over noise floor")
    for k, head in enumerate(("effect", "found", "Cramér-Rao (3.6 sigma)", "share by size")):
        table.add_column(head, justify="left" if k in (0, 3) else "right")
    for s in found:
        table.add_row(s.effect, *sensitivity_texts(s))
    console.print(table)


def sensitivity_texts(s: Sensitivity) -> tuple[str, str, str]:
    """Return smallest, bound and the shares as texts."""
    smallest = "–" if s.smallest is None else f"{s.smallest:g}"
    shares = "  ".join(f"{r:g}: {100 * share:.0f} %" for r, share in s.found.items())
    return smallest, f"{s.bound:.2f}", shares


def _percent(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f}"


def _criteria(scores: Sequence[CaseScore]) -> Table:
    table = Table(title="What must be reached")
    for name in ("figure", "found", "target", "cases", ""):
        table.add_column(name, justify="left" if name in ("figure", "") else "right")
    for c in criteria(scores):
        sign = "≥" if c.at_least else "≤"
        word = {True: "[green]reached", False: "[red]not reached", None: "not measured"}[c.reached]
        table.add_row(c.name, c.shown(c.value), f"{sign} {c.shown(c.target)}", str(c.cases), word)
    return table


def _kinds(scores: Sequence[CaseScore]) -> Table:
    table = Table(title="By kind (joints, depends: % right)")
    heads = ("kind", "cases", "right", "tie", "false", "admitted", "joints", "depends",
             "remainder", "|z|≥3 %", "s", "needless ties")  # fmt: skip
    for k, head in enumerate(heads):
        table.add_column(head, justify="left" if k == 0 else "right", no_wrap=k == 0)
    for t in by_kind(scores):
        good = t.right + t.tied == t.cases
        table.add_row(
            t.kind if good else f"[red]{t.kind}",
            str(t.cases),
            str(t.right),
            str(t.tied),
            str(t.false),
            str(t.admitted),
            _percent(t.joints),
            _percent(t.depends),
            "–" if t.remainder is None else f"{t.remainder:.2f}",
            _percent(t.z_far),
            "–" if t.seconds is None else f"{t.seconds:.2f}",
            str(t.needless),
        )
    return table


def _matrix(scores: Sequence[CaseScore]) -> Table:
    """Return the confusion matrix row by row: what was put in, and all that was named."""
    rows, columns, cells = matrix(scores)
    table = Table(title="Put in, and named (cases)")
    table.add_column("put in", no_wrap=True)
    table.add_column("named")
    for r in rows:
        named = sorted(((cells[r].get(c, 0.0), c) for c in columns), reverse=True)
        table.add_row(r, "   ".join(f"{c} {v:.3g}" for v, c in named if v))
    return table


def _wrong(scores: Sequence[CaseScore], most: int = 60) -> Table:
    table = Table(title=f"What went wrong ({len(scores)} cases; repeat with --kinds KIND --seed S)")
    for head in ("kind", "seed", "arm", "outcome", "put in", "named", "said"):
        table.add_column(head)
    for s in list(scores)[:most]:
        table.add_row(
            s.kind, str(s.seed), s.arm, s.outcome, " ".join(s.put_in), " ".join(s.named),
            s.message[:100],
        )  # fmt: skip
    return table
