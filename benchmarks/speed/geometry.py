"""Calibration: flexibilities alone, and the whole geometry, beside numerical derivatives."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from benchmarks.speed import task
from benchmarks.speed.linear_fit import fit_linear
from benchmarks.speed.peers.pinocchio_task import PinocchioTask
from benchmarks.speed.sides import Side, compared, interleaved
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.observables.predicted_readings import unmeasured_readings
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.kernels import reference as kernel
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

OURS, PEER = "ours", "least_squares, numerical derivatives"
NOISE = 2e-5  # m
CONVERGED = 1e-9  # of the parameters' usual sizes


def linear(count: int, rounds: int) -> dict[str, Any]:
    """Return the row of the twelve flexibilities from ``count`` poses."""
    model, (q, loads) = task.rigid(), task.rows(count)
    assert loads.wrench is not None
    truth = np.concatenate([task.AXIAL, task.RADIAL])
    form = model.linear_form(q, loads).regressor[:, :3]
    gap = form @ truth + np.random.default_rng(3).normal(0, NOISE, (count, 3))
    pin = PinocchioTask(model.chain(), model.rows(q[:1], loads[:1]))
    wrench = loads.wrench

    def residual(scaled: np.ndarray) -> np.ndarray:
        c = 1e-6 * scaled
        rows = [pin.regressor(q[r], wrench[r])[0] @ c - gap[r] for r in range(count)]
        return 1e3 * np.concatenate(rows)

    found: dict[str, Any] = {}

    def theirs() -> None:
        found["theirs"] = least_squares(residual, np.zeros(12), method="lm")

    def ours() -> None:
        for _ in range(20):
            found["ours"] = fit_linear(model, q, loads, gap)

    figures = interleaved([Side(OURS, ours, 20), Side(PEER, theirs)], rounds)
    off = np.abs(found["ours"].flexibility - 1e-6 * found["theirs"].x).max()
    return compared(
        f"12 flexibilities from {count} poses", "1,000 times", figures, [(PEER, OURS)],
        same_optimum_rad_per_Nm=float(off), evaluations=int(found["theirs"].nfev),
    )  # fmt: skip


def whole(count: int, turns: int = 1) -> dict[str, Any]:
    """Return the row of the whole geometry with flexibilities: ``turns`` of each side."""
    model = task.rigid()
    observable = make_observable("position", registered=True)
    parameters = identifiable_parameters(model, observable=observable, pulls=True)
    q, loads = task.rows(count)
    rng = np.random.default_rng(4)
    size = 0.3 * parameters.scales
    truth = np.clip(rng.normal(0, size), parameters.lower, parameters.upper)
    true = parameters.model(truth)
    value = true.predict(q, loads).position + rng.normal(0, NOISE, (count, 3))
    readings = replace(unmeasured_readings("position", q, loads), value=value)
    nuisance = observable.start(model, readings)
    rounds: list[tuple[float, float]] = []
    for _ in range(turns):
        begin = time.thread_time()
        ours = _newton(parameters, observable, readings, nuisance)
        middle = time.thread_time()
        theirs, calls = _numerical(parameters, q, loads, value)
        rounds.append((middle - begin, time.thread_time() - middle))
    gain = np.array([b / a for a, b in rounds])
    costs = [float(np.sum((parameters.model(v).predict(q, loads).position - value) ** 2))
             for v in (ours, theirs)]  # fmt: skip
    off = np.abs((ours - theirs) / parameters.scales).max()
    sides = {
        name: {"rounds": turns, "cpu_s": {"median": float(np.median([r[k] for r in rounds]))},
               "wall_s": {"median": float("nan")}}
        for k, name in enumerate((OURS, PEER))
    }  # fmt: skip
    return {
        "row": f"whole geometry, {len(parameters)} parameters, {count} poses",
        "goal": "20 times, same optimum", "sides": sides,
        "ratios": [{"peer": PEER, "ours": OURS, "median": float(np.median(gain)),
                    "p25": float(gain.min()), "p75": float(gain.max()), "kind": "cpu_s"}],
        "cost_m2": {"ours": costs[0], "theirs": costs[1]}, "off_in_usual_sizes": float(off),
        "evaluations": calls,
    }  # fmt: skip


def _newton(parameters: Parameters, observable: Any, readings: Any, nuisance: Any) -> np.ndarray:
    """Return the optimum by Gauss and Newton on the exact prediction."""
    values = parameters.begin.copy()
    for _ in range(12):
        gap = observable.residual(parameters.model(values), readings, nuisance).ravel()
        J, _ = observable.columns(parameters, values, readings, nuisance)
        scaled = J * parameters.scales
        step = np.linalg.lstsq(scaled, gap, rcond=1e-12)[0]
        values = values + parameters.scales * step
        if np.abs(step).max() < CONVERGED:
            break
    return np.asarray(values)


def _numerical(
    parameters: Parameters, q: np.ndarray, loads: Loads, value: np.ndarray
) -> tuple[np.ndarray, int]:
    """Return the optimum by scipy, row by row predicted, derivatives by differences."""
    calls = 0

    def predicted(model: Model) -> np.ndarray:
        position, rotation = np.empty((len(q), 3)), np.empty((len(q), 3, 3))
        kernel.predict_rows(model.chain(), model.rows(q, loads), position, rotation)
        return position

    def residual(scaled: np.ndarray) -> np.ndarray:
        nonlocal calls
        calls += 1
        model = parameters.model(parameters.scales * scaled)
        return 1e3 * (predicted(model) - value).ravel()

    begin = parameters.begin / parameters.scales
    found = least_squares(residual, begin, method="lm", xtol=1e-9, ftol=1e-11)
    return parameters.scales * found.x, calls
