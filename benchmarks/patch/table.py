"""The figures as lines, as a table of the page, and as a picture."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

BEGIN, END = "<!-- benchmarks.patch -->", "<!-- end -->"
SMALL = {"m": ("mm", 1e3), "rad": ("mrad", 1e3)}


def line(result: dict[str, Any]) -> str:
    """Return one result for the terminal."""
    head = f"{result['arm']:6} {result['effect']:22}"
    if "error" in result:
        return f"{head} {result['error']}"
    gap, patched, floor = (_size(result, key) for key in ("gap", "patched", "floor"))
    named = "named" if result["named"] else "NOT NAMED"
    beside = f" beside {', '.join(result['others'])}" if result["others"] else ""
    ties = f" tie {', '.join(result['ties'])}" if result["ties"] else ""
    found = f"{named} {_number(result['found'])} of {_number(result['value'])}{beside}{ties}"
    sizes = f"{gap} -> {patched}, floor {floor}"
    return f"{head} {found}; {sizes}: {result['verdict']} ({result['seconds']:g} s)"


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.4g}"


def _size(result: dict[str, Any], key: str) -> str:
    if result[key] is None:
        return "unknown"
    unit, factor = SMALL.get(result["unit"], (result["unit"], 1.0))
    return f"{factor * result[key]:.3g} {unit}"


def fill_page(page: Path, results: Sequence[dict[str, Any]]) -> None:
    """Put the table between the page's marks."""
    rows = ["| arm | effect | put in | named with | gap | patched | floor | after the patch |",
            "| --- | --- | --- | --- | --- | --- | --- | --- |"]  # fmt: skip
    for r in results:
        if "error" in r:
            rows.append(f"| {r['arm']} | `{r['effect']}` | | {r['error']} | | | | |")
            continue
        found = _number(r["found"]) if r["named"] else "not named"
        found += f", beside {', '.join(f'`{o}`' for o in r['others'])}" if r["others"] else ""
        found += f" (or {', '.join(f'`{t}`' for t in r['ties'])})" if r["ties"] else ""
        sizes = " | ".join(_size(r, key) for key in ("gap", "patched", "floor"))
        rows.append(
            f"| {r['arm']} | `{r['parameter']}` | {_number(r['value'])} | {found} | {sizes} | "
            f"`{r['verdict']}` |"
        )
    text = page.read_text(encoding="utf-8")
    table = "\n".join(rows)
    new = re.sub(
        f"{re.escape(BEGIN)}.*?{re.escape(END)}", lambda _: f"{BEGIN}\n{table}\n{END}", text,
        flags=re.DOTALL,
    )  # fmt: skip
    page.write_text(new, encoding="utf-8")


def draw(path: Path, results: Sequence[dict[str, Any]]) -> None:
    """Draw gap, patched gap and floor of each case as multiples of its floor."""
    import matplotlib as mpl

    mpl.use("svg")
    mpl.rcParams["svg.hashsalt"] = "gapbridge"
    from matplotlib import pyplot as plt

    arms = list(dict.fromkeys(r["arm"] for r in results))
    shown = [r for r in results if "error" not in r]
    figure, axes = plt.subplots(1, len(arms), figsize=(10, 6), sharey=True, squeeze=False)
    effects = list(dict.fromkeys(r["effect"] for r in shown))
    for axis, arm in zip(axes[0], arms, strict=True):
        for r in (r for r in shown if r["arm"] == arm):
            y = len(effects) - effects.index(r["effect"])
            gap, patched = (max(r[key] / r["floor"], 1e-2) for key in ("gap", "patched"))
            axis.plot([gap, patched], [y, y], color="#c8c8c8", zorder=1)
            axis.scatter(gap, y, color="#b3402c", zorder=2)
            axis.scatter(patched, y, color="#2c6fb3", zorder=2)
        axis.axvline(1, color="#555555", linewidth=1, linestyle="--")
        axis.set_xscale("log")
        axis.set_title(arm)
        axis.set_xlabel("gap over noise floor")
    axes[0][0].set_yticks(range(len(effects), 0, -1), effects)
    axes[0][0].scatter([], [], color="#b3402c", label="your model as it was")
    axes[0][0].scatter([], [], color="#2c6fb3", label="patched")
    axes[0][0].plot([], [], color="#555555", linestyle="--", label="noise floor")
    figure.legend(loc="lower center", ncols=3, frameon=False)
    figure.tight_layout(rect=(0, 0.05, 1, 1))
    figure.savefig(path, metadata={"Date": None})
