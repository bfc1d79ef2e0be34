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
    """Write one SVG per kind of growth that was measured."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed.plots")
    parser.add_argument("figures", type=Path, nargs="?", default=Path("out/speed.json"))
    parser.add_argument("--fleet", type=Path, help="figures of `benchmarks.fleet growth --json`")
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    given = parser.parse_args()
    found = json.loads(given.figures.read_text(encoding="utf-8"))["growth"]
    every = {"rows": _rows, "joints": _joints, "effects": _effects, "poses": _poses}
    drawn = {f"speed_{kind}": draw for kind, draw in every.items() if kind in found}
    if given.fleet is not None:
        found |= json.loads(given.fleet.read_text(encoding="utf-8"))
        drawn["speed_arms"] = _arms
    plt.switch_backend("svg")
    mpl.rcParams["svg.hashsalt"] = "gapbridge"  # the same figures make the same file
    given.out.mkdir(parents=True, exist_ok=True)
    for name, draw in drawn.items():
        figure, axes = plt.subplots(figsize=(6.4, 3.6), layout="constrained")
        draw(axes, found)
        axes.grid(True, which="major", color="#dddddd", linewidth=0.6)
        axes.spines[["top", "right"]].set_visible(False)
        if len(axes.get_lines()) > 1:
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


def _effects(axes: Any, found: dict[str, Any]) -> None:
    effects = [one["effects"] for one in found["effects"]]
    axes.plot(effects, [one["diagnose_s"] for one in found["effects"]], "o-", color=BLUE)
    axes.set(xlabel="effects looked at, 70 poses", ylabel="CPU time of a diagnosis, s")
    axes.set_ylim(bottom=0.0)


def _poses(axes: Any, found: dict[str, Any]) -> None:
    poses = [one["poses"] for one in found["poses"]]
    axes.plot(poses, [one["diagnose_s"] for one in found["poses"]], "o-", color=BLUE)
    axes.set(xscale="log", yscale="log", xlabel="poses, whole catalogue",
             ylabel="CPU time of a diagnosis, s")  # fmt: skip


def _arms(axes: Any, found: dict[str, Any]) -> None:
    arms = [int(count) for count in found["whole_s"]]
    axes.plot(arms, list(found["whole_s"].values()), "o-", color=BLUE,
              label="two processes, their start included")  # fmt: skip
    loop = 1e-3 * found["growth"]["per_session_ms"]["loop"]["median"]
    axes.plot(arms, [count * loop for count in arms], "--", color=ORANGE,
              label="a bare loop, nothing started or kept")  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="arms, a session of ten poses each",
             ylabel="gapbridge fleet fit, s")  # fmt: skip


if __name__ == "__main__":
    main()
