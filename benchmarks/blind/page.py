"""Writes the outcome of the blind benchmark as one HTML file that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path

import numpy as np

from benchmarks.blind.report import sensitivity_texts
from benchmarks.blind.score import NOWHERE, CaseScore
from benchmarks.blind.sensitivity import Sensitivity
from benchmarks.blind.tally import NONE, by_kind, criteria, matrix, z_scores

STYLE = """
:root { color-scheme: light dark; --line: #8884; --good: #2a8f4d; --bad: #c43d3d; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 1200px; margin: 2rem auto; padding: 0 1rem }
h1 { font-size: 1.6rem } h2 { font-size: 1.15rem; margin-top: 2.2rem }
table { border-collapse: collapse; font-size: .86rem }
td, th { padding: .2rem .5rem; border-bottom: 1px solid var(--line); text-align: right }
td:first-child, th:first-child { text-align: left; white-space: nowrap }
.good { color: var(--good) } .bad { color: var(--bad); font-weight: 600 }
.wide { overflow-x: auto } .matrix th { vertical-align: bottom; font-weight: 500 }
.matrix th span { writing-mode: vertical-rl; transform: rotate(180deg); display: inline-block }
.matrix td { text-align: center; min-width: 2rem }
svg { max-width: 100%; height: auto } p.note { color: #888; max-width: 70ch }
"""


def write_page(
    path: Path, scores: Sequence[CaseScore], title: str, notes: str = "",
    small: Sequence[Sensitivity] = (),
) -> None:  # fmt: skip
    """Write the page."""
    parts = [
        f"<!doctype html><html lang='en'><head><meta charset='utf-8'><title>{escape(title)}</title>"
        f"<meta name='viewport' content='width=device-width'><style>{STYLE}</style></head><body>",
        f"<h1>{escape(title)}</h1><p class='note'>{escape(notes)}</p>",
        "<h2>What must be reached</h2>", _criteria(scores),
        "<h2>Put in (rows) and named (columns)</h2><p class='note'>Share of the row's cases."
        " Several names share one case. Framed: where the answer is right.</p>", _matrix(scores),
        "<h2>By kind</h2>", _kinds(scores),
        "<h2>z-scores of the parameters</h2>",
        _histogram(z_scores(scores), -5, 5, 40, "(estimate − truth) / std", bell=True),
        "<h2>Held-out remainder over the true noise floor</h2>",
        _histogram([s.remainder for s in scores if s.remainder is not None], 0.7, 1.7, 40, "ratio"),
        "<h2>Run times</h2>",
        _histogram([np.log10(s.seconds) for s in scores if s.seconds], -2, 2, 40,
                   "log10 of seconds a case"),
        _sensitivity(small),
        "<h2>What went wrong</h2>", _wrong(scores),
        "</body></html>",
    ]  # fmt: skip
    path.write_text("\n".join(parts), encoding="utf-8")


def _table(heads: Iterable[str], rows: Iterable[Iterable[str]], css: str = "") -> str:
    head = "".join(f"<th>{h}</th>" for h in heads)
    body = "".join(f"<tr>{''.join(cells)}</tr>" for cells in rows)
    return f"<div class='wide'><table class='{css}'><tr>{head}</tr>{body}</table></div>"


def _td(text: str, css: str = "", style: str = "") -> str:
    return f"<td class='{css}' style='{style}'>{escape(text)}</td>"


def _criteria(scores: Sequence[CaseScore]) -> str:
    rows = []
    for c in criteria(scores):
        word = {True: "reached", False: "not reached", None: "not measured"}[c.reached]
        css = {True: "good", False: "bad", None: ""}[c.reached]
        sign = "≥" if c.at_least else "≤"
        target = f"{sign} {c.shown(c.target)}"
        texts = (c.name, c.shown(c.value), target, str(c.cases))
        rows.append([*(_td(t) for t in texts), _td(word, css)])
    return _table(("figure", "found", "target", "cases", ""), rows)


def _matrix(scores: Sequence[CaseScore]) -> str:
    rows, columns, cells = matrix(scores)
    heads = ["put in", *(f"<span>{escape(c)}</span>" for c in columns)]
    body = []
    for r in rows:
        total = sum(cells[r].values())
        line = [_td(f"{r} ({total:.0f})")]
        for c in columns:
            share = cells[r].get(c, 0.0) / total
            right = _is_right(r, c)
            colour = "42,143,77" if right else "196,61,61"
            style = f"background:rgba({colour},{0.85 * share:.2f});"
            style += "outline:1px solid #2a8f4d88" if right else ""
            line.append(_td(f"{100 * share:.0f}" if share else "", style=style))
        body.append(line)
    return _table(heads, body, "matrix")


def _is_right(row: str, column: str) -> bool:
    if row.startswith((NOWHERE, "withheld:")):
        return column == NOWHERE
    effects = row.rpartition(":")[2].split("+")
    return column in effects or (column == NONE and effects == ["none"])


def _kinds(scores: Sequence[CaseScore]) -> str:
    heads = ("kind", "group", "cases", "right", "tie reported", "accused falsely", "admitted",
             "joints right", "depends right", "remainder", "|z| ≥ 3", "median s",
             "outcomes")  # fmt: skip
    rows = []
    for t in by_kind(scores):
        good = t.right + t.tied == t.cases
        texts = (
            t.group, t.cases, t.right, t.tied, t.false, t.admitted, _share(t.joints),
            _share(t.depends), "–" if t.remainder is None else f"{t.remainder:.2f}",
            _share(t.z_far), "–" if t.seconds is None else f"{t.seconds:.2f}",
            ", ".join(f"{k} {v}" for k, v in t.outcomes.items()),
        )  # fmt: skip
        rows.append([_td(t.kind, "good" if good else "bad"), *(_td(str(x)) for x in texts)])
    return _table(heads, rows)


def _share(value: float | None) -> str:
    return "–" if value is None else f"{100 * value:.0f} %"


def _histogram(
    values: Sequence[float], low: float, high: float, bins: int, label: str, bell: bool = False
) -> str:
    """Return an SVG histogram; values beyond the ends are put into the last bins."""
    if not values:
        return "<p class='note'>Nothing to show.</p>"
    counts, edges = np.histogram(np.clip(values, low, high), bins=bins, range=(low, high))
    width, height, foot = 720, 200, 34
    step = width / bins
    most = max(int(counts.max()), 1)
    bars = "".join(
        f"<rect x='{k * step:.1f}' y='{height - height * c / most:.1f}' width='{step - 1:.1f}' "
        f"height='{height * c / most:.1f}' fill='#4a7fb5'/>"
        for k, c in enumerate(counts)
    )
    curve = ""
    if bell:
        x = np.linspace(low, high, 120)
        density = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi) * len(values) * (high - low) / bins
        points = " ".join(
            f"{(a - low) / (high - low) * width:.1f},{height - height * min(d / most, 1):.1f}"
            for a, d in zip(x, density, strict=True)
        )
        curve = f"<polyline points='{points}' fill='none' stroke='#c43d3d' stroke-width='1.5'/>"
    ticks = "".join(
        f"<text x='{k * step:.0f}' y='{height + 14}' font-size='11' fill='#888'>"
        f"{edges[k]:.2g}</text>"
        for k in range(0, bins + 1, max(bins // 10, 1))
    )
    note = f"{label}; {len(values)} values, median {np.median(values):.3g}"
    return (
        f"<svg viewBox='0 0 {width + 20} {height + foot}' role='img'>{bars}{curve}{ticks}"
        f"<text x='0' y='{height + 30}' font-size='12' fill='#888'>{escape(note)}</text></svg>"
    )


def _sensitivity(small: Sequence[Sensitivity]) -> str:
    if not small:
        return ""
    heads = ("effect", "smallest found in 95 %", "Cramér-Rao bound (3.6 sigma)", "share by size")
    rows = [[_td(s.effect), *(_td(t) for t in sensitivity_texts(s))] for s in small]
    return "<h2>Sensitivity: gap over noise floor</h2>" + _table(heads, rows)


def _wrong(scores: Sequence[CaseScore]) -> str:
    rows = [
        [_td(s.kind), _td(str(s.seed)), _td(s.arm), _td(s.outcome), _td(" ".join(s.put_in)),
         _td(" ".join(s.named)), _td(s.message)]
        for s in scores if not s.ok
    ]  # fmt: skip
    if not rows:
        return "<p class='note'>Nothing.</p>"
    return _table(("kind", "seed", "arm", "outcome", "put in", "named", "said"), rows)
