"""The pictures of docs/performance.md, from the figures: ``python -m benchmarks.speed.plots``."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib import pyplot as plt

BLUE, ORANGE, GREEN = "#2563a8", "#c2571a", "#3a7d44"


def main() -> None:
    """Write one SVG per kind of growth."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed.plots")
    parser.add_argument("figures", type=Path, nargs="?", default=Path("out/speed.json"))
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    given = parser.parse_args()
    found = json.loads(given.figures.read_text(encoding="utf-8"))["growth"]
    plt.switch_backend("svg")
    mpl.rcParams["svg.hashsalt"] = "gapbridge"  # the same figures make the same file
    given.out.mkdir(parents=True, exist_ok=True)
    for name, draw in (("speed_rows", _rows), ("speed_joints", _joints)):
        figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
        draw(axes, found)
        axes.grid(True, which="major", color="#dddddd", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        axes.legend(frameon=False)
        path = given.out / f"{name}.svg"
        figure.savefig(path, metadata={"Date": None})
        print(path)


def _rows(axes: Any, found: dict[str, Any]) -> None:
    rows = [one["rows"] for one in found["rows"]]
    for key, label, colour in (
        ("predict_s", "exact poses", BLUE),
        ("linear_form_s", "linear form, stored", ORANGE),
        ("fit_s", "fit, rows never stored", GREEN),
    ):
        per_row = [1e9 * one[key] / one["rows"] for one in found["rows"]]
        axes.plot(rows, per_row, "o-", color=colour, label=label)
    axes.set(xscale="log", yscale="log", xlabel="rows", ylabel="CPU time per row, ns")


def _joints(axes: Any, found: dict[str, Any]) -> None:
    joints = [one["joints"] for one in found["joints"]]
    axes.plot(joints, [1e6 * one["predict_per_row_s"] for one in found["joints"]], "o-",
              color=BLUE, label="exact pose of one row, in blocks")  # fmt: skip
    axes.plot(joints, [1e6 * one["setpoint_s"] for one in found["joints"]], "s-",
              color=ORANGE, label="exact correction of one setpoint")  # fmt: skip
    axes.set(yscale="log", xlabel="joints", ylabel="CPU time, us")


if __name__ == "__main__":
    main()
