"""Plans against random poses, and what plans promise against what sessions show.

    python -m benchmarks.calibration.design [--cells 20] [--poses 30] [--sessions 1000]

For each random cell: the predicted TCP's 1 sigma that the planned poses leave (rms over the
workspace and all loads, and at its worst place), and how many random poses it takes to equal them;
random ones are drawn uniformly from the same reachable, visible poses under the same loads. Beside
it, how many random poses would equal the best that any choice of as many poses could reach
(``best_possible.py``): no planner gets beyond that. Then the scatter of every parameter, and of the
predicted TCP, over repeated simulated sessions, as a share of what the plan had promised.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from threadpoolctl import threadpool_limits

from benchmarks.calibration.best_possible import least_possible
from benchmarks.calibration.random_cells import RandomCell, random_cell
from benchmarks.calibration.repeated import Scatter, repeated_sessions
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.observables.predicted_readings import unmeasured_readings
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.plan import Plan
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.loads import Loads
from gapbridge.core.planning.candidates import sample_candidates
from gapbridge.core.planning.design import SessionDesign, draw_reference, load_extent, plan
from gapbridge.core.planning.information import Reference, information_of, inverse, whitened_rows

Array = NDArray[np.float64]
SIGMA = 3e-5
DRAWS = 101  # random choices of each number of poses
TIMES = (1.0, 1.5, 1.75, 2.0, 2.25, 2.5, 3.0)  # of the planned number
POOL = 2000  # poses over which the best possible choice is bounded
SHOWN = 3.0  # a parameter counts as determined where the weak prior is this many times as wide


@dataclass(frozen=True)
class Row:
    """One cell's figures; lengths in m."""

    cell: str
    parameters: int
    loads: int
    planned: float  # rms over the workspace
    planned_worst: float
    random: dict[str, float]  # times as many poses: median rms of random choices
    random_worst: dict[str, float]
    equal: float  # times as many random poses give the plan's rms; inf: more than 3
    equal_worst: float  # the same for the worst place
    possible: float  # rms that no choice of as many poses can come below
    equal_possible: float  # times as many random poses give that
    reported: int  # parameters that the plan shows
    scatter: list[float]  # scatter / expected of each of them
    scatter_tcp: float  # of the predicted TCP, rms
    travel: float  # s
    seconds: float  # CPU time of planning


def readings_of(planned: Plan, kind: str) -> Readings:
    """Return the readings, without values, that a plan asks for."""
    poses = planned.poses
    load = np.array([pose.load for pose in poses])
    loads = Loads(
        payload_mass=np.array([one.mass for one in planned.loads])[load],
        payload_cog=np.array([one.cog for one in planned.loads], dtype=float)[load],
        approach=np.array([pose.approach for pose in poses]),
    )
    readings = unmeasured_readings(
        kind, np.array([pose.q for pose in poses]), loads, load=load,
        station=np.array([pose.station for pose in poses]),
        target=np.array([pose.target for pose in poses]),
        pose=np.array([pose.number for pose in poses]),
    )  # fmt: skip
    readings.held_out[:] = [pose.held_out for pose in poses]
    return readings


def row_of(cell: RandomCell, observable: Observable, poses: int, sessions: int, seed: int) -> Row:
    """Return the figures of one cell."""
    parameters = identifiable_parameters(cell.model, observable=observable)
    begin = time.process_time()
    planned = plan(
        parameters, observable, cell.loads, cell.space,
        SessionDesign(poses=poses, repeats=0, sigma=SIGMA, seed=seed),
    )  # fmt: skip
    seconds = time.process_time() - begin
    hung = tuple(load_extent(load) for load in planned.loads)
    cell = replace(cell, space=replace(cell.space, loads_end=hung))  # the planner's, loads and all
    reference = draw_reference(parameters, planned.loads, cell.space, seed)
    rms, worst = chosen_at_random(cell, parameters, observable, reference, poses, seed)
    possible = least_of_all(cell, parameters, observable, reference, planned)
    scatter = repeated_sessions(
        parameters, observable, readings_of(planned, observable.kind), Nuisance.zero(),
        sigma=SIGMA, sessions=sessions, seed=seed,
    )  # fmt: skip
    expected = planned.expected
    shown = expected.std < parameters.prior / SHOWN
    return Row(
        cell.name, len(parameters), len(cell.loads), expected.tcp_std, expected.tcp_std_worst,
        _named(rms), _named(worst), equal_to(expected.tcp_std, rms),
        equal_to(expected.tcp_std_worst, worst), possible, equal_to(possible, rms),
        int(shown.sum()),
        [float(r) for r in scatter.std[shown] / expected.std[shown]],
        tcp_scatter(scatter, parameters, reference) / expected.tcp_std, planned.travel, seconds,
    )  # fmt: skip


def chosen_at_random(
    cell: RandomCell,
    parameters: Parameters,
    observable: Observable,
    reference: Reference,
    poses: int,
    seed: int,
) -> tuple[list[float], list[float]]:
    """Return medians of rms and worst deviation of random choices, for each of TIMES."""
    loads = sorted(cell.loads, key=lambda load: load.mass)
    found = sample_candidates(parameters, observable, loads, cell.space, seed + 1000, 500)
    rows = whitened_rows(parameters, observable, found.readings, found.nuisance, SIGMA)
    random = np.random.default_rng(seed)
    rms, worst = [], []
    for times in TIMES:
        stds = []
        for _ in range(DRAWS):
            some = random.choice(len(rows), round(times * poses), replace=False)
            stds.append(reference.std(inverse(information_of(rows[some]))))
        rms.append(float(np.median([np.sqrt(np.mean(std**2)) for std in stds])))
        worst.append(float(np.median([std.max() for std in stds])))
    return rms, worst


def least_of_all(
    cell: RandomCell, parameters: Parameters, observable: Observable, reference: Reference,
    planned: Plan,
) -> float:  # fmt: skip
    """Return the rms below which no choice of as many poses comes, of a pool and the planned."""
    found = sample_candidates(parameters, observable, planned.loads, cell.space, 0, POOL)
    own = readings_of(planned, observable.kind)
    own = own[~own.held_out]
    own = replace(own, value=observable.predict(parameters.nominal, own, found.nuisance))
    rows = np.concatenate([
        whitened_rows(parameters, observable, given, found.nuisance, SIGMA)
        for given in (found.readings, own)
    ])  # fmt: skip
    return least_possible(rows, reference.weight(rows.shape[2]), len(own))


def equal_to(planned: float, chance: list[float]) -> float:
    """Return how many times as many random poses give the planned deviation."""
    return float(np.interp(-planned, [-value for value in chance], TIMES, right=np.inf))


def tcp_scatter(scatter: Scatter, parameters: Parameters, reference: Reference) -> float:
    """Return the rms scatter (m, 3D) of the TCP that the sessions predict."""
    apart = (scatter.values - scatter.values.mean(axis=0)) / parameters.prior
    moved = np.einsum("mkp,sp->smk", reference.columns, apart)
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=2))))


def _named(values: list[float]) -> dict[str, float]:
    return {f"{times:g}": value for times, value in zip(TIMES, values, strict=True)}


def table_of(rows: list[Row]) -> Table:
    """Return the figures, lengths in micrometres."""
    table = Table(title="planned against random poses; promised against found")
    for column in (
        "cell", "p", "loads", "planned um", "random um", "2x random um", "equals", "worst um",
        "2x random um", "equals", "best um", "equals", "scatter/expected", "worst", "TCP",
        "travel s", "CPU s",
    ):  # fmt: skip
        table.add_column(column, justify="left" if column == "cell" else "right")
    for row in rows:
        ratio = np.array(row.scatter)
        table.add_row(
            row.cell, str(row.parameters), str(row.loads), f"{1e6 * row.planned:.1f}",
            f"{1e6 * row.random['1']:.1f}", f"{1e6 * row.random['2']:.1f}", f"{row.equal:.2f}x",
            f"{1e6 * row.planned_worst:.1f}", f"{1e6 * row.random_worst['2']:.1f}",
            f"{row.equal_worst:.2f}x", f"{1e6 * row.possible:.1f}", f"{row.equal_possible:.2f}x",
            f"{ratio.mean():.3f}",
            f"{ratio[np.argmax(np.abs(ratio - 1))]:.3f}", f"{row.scatter_tcp:.3f}",
            f"{row.travel:.0f}", f"{row.seconds:.1f}",
        )  # fmt: skip
    return table


def summary_of(rows: list[Row]) -> dict[str, float]:
    """Return the figures over all cells."""
    ratio = np.concatenate([row.scatter for row in rows])
    equal = np.array([row.equal for row in rows])
    worst = np.array([row.equal_worst for row in rows])
    return {
        "cells": len(rows),
        "random poses equal to the plan, rms, median": float(np.median(equal)),
        "random poses equal to the plan, rms, least": float(equal.min()),
        "random poses equal to the best possible choice, rms, median": float(
            np.median([row.equal_possible for row in rows])
        ),
        "planned rms over the best possible, median": float(
            np.median([row.planned / row.possible for row in rows])
        ),
        "random poses equal to the plan, worst place, median": float(np.median(worst)),
        "random poses equal to the plan, worst place, least": float(worst.min()),
        "parameters reported": len(ratio),
        "scatter over expected, mean": float(ratio.mean()),
        "scatter over expected, share within 10 %": float(np.mean(np.abs(ratio - 1) < 0.1)),
        "scatter over expected, farthest from 1": float(np.abs(ratio - 1).max()),
        "scatter over expected, TCP, farthest from 1": float(
            max(abs(row.scatter_tcp - 1) for row in rows)
        ),
    }


def written(given: argparse.Namespace, rows: list[Row]) -> None:
    """Write the figures so far."""
    document = {
        "given": {k: v for k, v in vars(given).items() if k != "json"},
        "summary": summary_of(rows),
        "rows": [asdict(row) for row in rows],
    }
    given.json.parent.mkdir(parents=True, exist_ok=True)
    given.json.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def main() -> int:
    """Print the table, write the figures."""
    reader = argparse.ArgumentParser(prog="python -m benchmarks.calibration.design")
    reader.add_argument("--cells", type=int, default=20)
    reader.add_argument("--first", type=int, default=0, help="seed of the first cell")
    reader.add_argument("--kind", default="position", help="of the readings")
    reader.add_argument("--poses", type=int, default=30)
    reader.add_argument("--sessions", type=int, default=1000)
    reader.add_argument("--json", type=Path, default=Path("out/calibration_design.json"))
    given = reader.parse_args()
    console, rows = Console(width=170), []
    observable = make_observable(given.kind)
    with threadpool_limits(1):
        for seed in range(given.first, given.first + given.cells):
            cell = random_cell(seed)
            rows.append(row_of(cell, observable, given.poses, given.sessions, seed))
            console.print(f"{cell.name}: {rows[-1].equal:.2f}x, {rows[-1].equal_worst:.2f}x")
            written(given, rows)
    console.print(table_of(rows))
    for name, value in summary_of(rows).items():
        console.print(f"{name}: {value:.4g}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
