"""Measured data of real arms (../shared/data): diagnose, put the effects in, predict other poses.

Prints the distance of predicted from measured positions on poses that the diagnosis did not see,
mean and rms in mm, for the cell's model and for the one with the found effects. The instrument's
frame comes from the rows that were diagnosed; where another session is checked, from that session,
because the instrument stood elsewhere.
"""

from __future__ import annotations

import sys
import time

import numpy as np

from benchmarks.evidence import DATA
from benchmarks.evidence.measured import distances, published, registered, split
from gapbridge.bridge.cell import load_cell
from gapbridge.core.diagnosis.diagnosis import Diagnosis, diagnose
from gapbridge.core.log.log import Log, read_log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

SETS = ("tsinghua_ur5_grid", "barrett_wam_grid", "ipa_ur10_a", "ipa_ur10_b")
LATER = (("tsinghua_ur5_grid", "tsinghua_ur5_random"), ("barrett_wam_grid", "barrett_wam_random"),
         ("ipa_ur10_a", "ipa_ur10_b"))  # fmt: skip


def reported(what: str, far: np.ndarray) -> None:
    rms = float(np.sqrt(np.mean(far**2)))
    print(f"  {what:28s} mean {far.mean() * 1e3:8.4f}   rms {rms * 1e3:8.4f}", flush=True)


def with_effects(diagnosis: Diagnosis) -> Model:
    """Return the model that `--apply` writes; prints the causes."""
    for channel in diagnosis.channels:
        for cause in channel.causes:
            joints = ", ".join(str(j) for j in cause.joints)
            print(f"    {cause.effect} {joints}")
        print(f"    {channel.verdict}; the rest depends on {channel.depends_on[:3]}")
    return diagnosis.model


def report(name: str, cell_model: Model, learned: Log, checked: Log, metrology: Metrology) -> None:
    start = time.perf_counter()
    found = diagnose(cell_model, learned, metrology)
    seconds = time.perf_counter() - start
    print(f"{name}: {len(learned)} rows diagnosed in {seconds:.0f} s, {len(checked)} checked")
    model = with_effects(found)
    reported("cell's model", distances(cell_model, checked, registered(cell_model, learned)))
    reported("with the found effects", distances(model, checked, registered(model, learned)))


def later(first: str, second: str) -> None:
    """Diagnose one session and predict another one of the same arm."""
    cell = load_cell(DATA / first / "cell.yaml")
    learned = read_log(DATA / first / "log.csv", cell.arm.n)
    checked = read_log(DATA / second / "log.csv", cell.arm.n)
    model = diagnose(cell.model, learned, cell.metrology).model
    print(f"{first}, all {len(learned)} rows diagnosed; {second}, {len(checked)} rows checked")
    reported("cell's model", distances(cell.model, checked, registered(cell.model, checked)))
    reported("with the found effects", distances(model, checked, registered(model, checked)))


def main(names: list[str]) -> None:
    for name in SETS:
        folder = DATA / name
        if names and name not in names:
            continue
        if not (folder / "log.csv").is_file():
            print(f"{name}: not there ({folder})")
            continue
        cell = load_cell(folder / "cell.yaml")
        learned, checked = split(read_log(folder / "log.csv", cell.arm.n))
        title = f"\n{name}, a fifth of the poses held out"
        report(title, cell.model, learned, checked, cell.metrology)
        for line in published(folder):
            print(f"  {line}")
    for first, second in LATER:
        if (not names or first in names) and (DATA / second / "log.csv").is_file():
            later(first, second)


if __name__ == "__main__":
    main(sys.argv[1:])
