"""Measured data of real arms (../shared/data): fit, then predict poses that the fit did not see.

Prints the distance of predicted from measured positions on the held-out poses, mean and rms in mm,
for the rigid arm and for the fitted one, the instrument's frame always taken from the fitted rows
alone; then the same with the tool point (3 numbers) fitted before, because these sets do not know
it; then the published figure. Where the fit declines, its reason stands instead.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from benchmarks.evidence import DATA
from gapbridge.bridge.cell import load_cell
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.held_out import pose_groups
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.estimation.registration import Registration, frame_columns, register_robustly
from gapbridge.core.log.log import Log, read_log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

HELD_OUT = 5  # every fifth pose
PAIRS = [("tsinghua_ur5_grid", "tsinghua_ur5_random"), ("barrett_wam_grid", "barrett_wam_random"),
         ("ipa_ur10_a", ""), ("ipa_ur10_b", "")]  # fmt: skip


def distances(model: Model, log: Log, frame: Registration) -> np.ndarray:
    """Return how far (N,) m the measured positions are from the predicted ones."""
    predicted = model.predict(log.require("actual_q"), log.loads()).position
    gap = frame.in_base(log.require("measured_position")) - predicted
    return np.linalg.norm(gap, axis=1)


def registered(model: Model, log: Log) -> Registration:
    predicted = model.predict(log.require("actual_q"), log.loads()).position
    return register_robustly(log.require("measured_position"), predicted)


def with_tool_point(model: Model, log: Log) -> Model:
    """Return the model with the tool point that fits the log best, beside the frame."""
    q, measured = log.require("actual_q"), log.require("measured_position")
    frame = registered(model, log)
    for _ in range(10):
        poses = model.predict(q, log.loads())
        gap = frame.in_base(measured) - poses.position
        turn = poses.rotation @ model.tool_in_flange[:3, :3].T
        columns = np.concatenate([turn, -frame_columns(poses.position)[:, :3]], axis=2)
        step = np.linalg.lstsq(columns.reshape(-1, 9), gap.ravel(), rcond=None)[0]
        tool = model.tool_in_flange.copy()
        tool[:3, 3] += step[:3]
        model, frame = replace(model, tool_in_flange=tool), frame.moved(step[3:])
    return model


def reported(what: str, far: np.ndarray) -> None:
    print(f"  {what:40s} mean {far.mean() * 1e3:8.4f}   rms {np.sqrt(np.mean(far**2)) * 1e3:8.4f}")


def compare(model: Model, fit: Log, held_out: Log, metrology: Metrology) -> None:
    """Print the held-out error before and after."""
    for start, what in ((model, "cell's tool"), (with_tool_point(model, fit), "fitted tool point")):
        reported(f"rigid, {what}", distances(start, held_out, registered(start, fit)))
        try:
            found = identify_compliance(start, fit, metrology)
        except InputError as error:
            print(f"  fit declines: {error}")
            continue
        reported(f"compliance fitted, {what}", distances(found.model, held_out, found.registration))
        shown = ", ".join(
            f"{kind} {i + 1}: {max(value, 0) * 1e6:.1f}±{std * 1e6:.1f}"
            for kind, values, stds, first in (
                ("axial", found.axial, found.std_axial, 0),
                ("radial", found.radial, found.std_radial, model.arm.n),
            )
            for i, (value, std) in enumerate(zip(values, stds, strict=True))
            if found.identifiable[first + i]
        )
        print(f"    1e-6 rad/Nm: {shown or 'nothing shown'}")


def split(log: Log) -> tuple[Log, Log]:
    """Return four fifths of the poses and the rest; repeated poses stay together."""
    fold = np.random.default_rng(0).permutation(len(log))[pose_groups(log.require("actual_q"))]
    return log.select(fold % HELD_OUT != 0), log.select(fold % HELD_OUT == 0)


def published(folder: Path) -> Iterator[str]:
    about = yaml.safe_load((folder / "ABOUT.yaml").read_text(encoding="utf-8"))
    if "published" in about:
        yield f"published: {about['published']}"
    measured = about.get("measured_by_us", {})
    for key in ("nominal, base and tool point fitted, mm rms",
                "full geometric model, held-out 20 %, mm rms", "random20_from_grid",
                "nominal_all", "geo_test"):  # fmt: skip
        if isinstance(measured, dict) and key in measured:
            yield f"known of this set: {key}: {measured[key]}"


def main() -> None:
    for fitted, checked in PAIRS:
        folder = DATA / fitted
        if not (folder / "log.csv").is_file():
            print(f"{fitted}: not there ({folder})")
            continue
        cell = load_cell(folder / "cell.yaml")
        log = read_log(folder / "log.csv", cell.arm.n)
        fit, held_out = split(log)
        print(f"\n{fitted}, mm: {len(fit)} rows fitted, {len(held_out)} of other poses checked")
        compare(cell.model, fit, held_out, cell.metrology)
        if checked:
            other = read_log(DATA / checked / "log.csv", cell.arm.n)
            print(f"{fitted}, mm: all {len(log)} rows fitted, {len(other)} of {checked} checked")
            compare(cell.model, log, other, cell.metrology)
        for line in published(folder):
            print(f"  {line}")


if __name__ == "__main__":
    main()
