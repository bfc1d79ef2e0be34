"""What the hierarchical fit is worth: poses that no fit saw, and whether its intervals hold.

Arms of a type with few poses each; the separate fit is ``gapbridge fit`` of each log by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.blind.mechanics import Array
from benchmarks.fleet.simulating import KIND, TYPE, Habits, columns, write_type_cell
from gapbridge.bridge.cell import load_cell
from gapbridge.core.errors import ExcitationError
from gapbridge.core.estimation.compliance_fit import Data, fit_nuisances, residual
from gapbridge.core.estimation.flexibilities import typical_flexibility
from gapbridge.core.estimation.hierarchical import fit_type
from gapbridge.core.estimation.hierarchical_evidence import evidence
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

HELD_OUT = 30  # poses of each session that no fit sees


@dataclass(frozen=True)
class Fleet:
    """One fleet's figures."""

    gaps: dict[str, Array]  # (A,) m, rms of one coordinate on held-out poses, by way
    inside: Array  # (intervals,) whether the truth lies in a 95 % interval; shown flexibilities
    inside_few: Array  # of the arms with the fewest poses


def run_fleet(model: Model, metrology: Metrology, poses: list[int], seed: int) -> Fleet:
    """Return the figures of one fleet whose arms have so many poses each, in one session."""
    rng = np.random.default_rng(seed)
    habits = Habits()
    truths, seen, held = [], [], []
    for count in poses:
        arm = TYPE.scattered(habits.between_arms, rng)
        truths.append(arm.flexibility)
        log = _log(columns(arm, count + HELD_OUT, habits, rng))
        order = rng.permutation(len(log))
        seen.append(log.select(np.sort(order[:count])))
        held.append(log.select(np.sort(order[count:])))
    given = [evidence(model, log, metrology) for log in seen]
    n = model.arm.n
    fit = fit_type(given, range(len(poses)), np.zeros(2 * n), typical_flexibility(model))
    ways: dict[str, list[float]] = {"cell": [], "type alone": [], "separate": [], "fleet": []}
    for i in range(len(poses)):
        flexibility = {
            "cell": np.zeros(2 * n), "type alone": fit.scatter.mean,
            "separate": _separate(model, seen[i], metrology),
            "fleet": fit.arms[i].flexibility,
        }  # fmt: skip
        for name, values in flexibility.items():
            deflected = model.with_compliance(values[:n], values[n:])
            ways[name].append(_gap(deflected, seen[i], held[i], metrology))
    inside = np.array([
        np.abs(fit.arms[i].flexibility - truths[i]) <= 1.96 * fit.arms[i].std
        for i in range(len(poses))
    ])[:, fit.scatter.identifiable]  # fmt: skip
    few = np.array(poses) == min(poses)
    gaps = {name: np.array(values) for name, values in ways.items()}
    return Fleet(gaps, inside.ravel(), inside[few].ravel())


def _log(given: dict[str, Array]) -> Log:
    return Log("simulated", given, KIND.n)


def _separate(model: Model, log: Log, metrology: Metrology) -> Array:
    try:
        found = identify_compliance(model, log, metrology)
    except ExcitationError:
        return np.zeros(2 * model.arm.n)
    return np.concatenate([found.axial, found.radial])


def _gap(model: Model, seen: Log, held: Log, metrology: Metrology) -> float:
    """Return the rms of one coordinate on held-out poses; frame and tool point from those seen."""

    def data(log: Log) -> Data:
        return Data(
            log.require("actual_q"), log.loads(), log.require("measured_position"), None,
            metrology.registered,
        )  # fmt: skip

    placed = fit_nuisances(model, data(seen))
    gap, _ = residual(placed.model, data(held), placed.frame)
    return float(np.sqrt(np.mean(gap**2)))


def measure(folder: Any, fleets: int, poses: list[int], seed: int) -> dict[str, Any]:
    """Return the figures over many fleets."""
    cell = load_cell(write_type_cell(folder))
    found = [run_fleet(cell.model, cell.metrology, poses, seed + i) for i in range(fleets)]
    gaps = {name: np.concatenate([f.gaps[name] for f in found]) for name in found[0].gaps}
    few = np.tile(np.array(poses) == min(poses), fleets)
    inside = np.concatenate([f.inside for f in found])
    inside_few = np.concatenate([f.inside_few for f in found])
    return {
        "fleets": fleets, "poses": poses, "held_out_poses": HELD_OUT,
        "held_out_rms_um": {k: _rms(v) for k, v in gaps.items()},
        "held_out_rms_um_few_poses": {k: _rms(v[few]) for k, v in gaps.items()},
        "arms_better_than_separate": float(np.mean(gaps["fleet"] < gaps["separate"])),
        "few_poses_better_than_separate":
            float(np.mean(gaps["fleet"][few] < gaps["separate"][few])),
        "coverage_95": float(inside.mean()), "coverage_95_few_poses": float(inside_few.mean()),
        "intervals": len(inside),
    }  # fmt: skip


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)) * 1e6)
