"""How cost grows: with rows, with joints, with effects and poses of a diagnosis."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.speed import diagnosis_growth, task
from benchmarks.speed.linear_fit import fit_linear
from gapbridge.core.kernels.many import predict
from gapbridge.core.kernels.reference import Chain, Rows
from gapbridge.core.kernels.single import correct

ROWS = (10, 100, 1_000, 10_000, 100_000)
KINDS = ("rows", "joints", "effects", "poses")
JOINTS = (2, 3, 4, 5, 6, 7, 8, 10, 12)


def _each(call: Callable[[], object], least: float = 0.02) -> float:
    """Return the median CPU time of a call, s, over five turns of ``least`` s at least."""
    call()
    begin = time.thread_time()
    call()
    once = max(time.thread_time() - begin, 1e-7)
    times = max(int(least / once), 1)
    found = []
    for _ in range(5):
        begin = time.thread_time()
        for _ in range(times):
            call()
        found.append((time.thread_time() - begin) / times)
    return float(np.median(found))


def growth(kinds: Sequence[str] = KINDS) -> dict[str, Any]:
    """Return CPU times by number of rows, of joints, and of a diagnosis' effects and poses."""
    measure: dict[str, Callable[[], list[dict[str, float]]]] = {
        "rows": lambda: [_rows(count) for count in ROWS],
        "joints": lambda: [_joints(n) for n in JOINTS],
        "effects": diagnosis_growth.by_effects,
        "poses": diagnosis_growth.by_poses,
    }
    return {kind: measure[kind]() for kind in kinds}


def _rows(count: int) -> dict[str, float]:
    model, (q, loads) = task.deflected(), task.rows(count)
    gap = np.random.default_rng(0).normal(0, 1e-4, (count, 3))
    return {
        "rows": count,
        "predict_s": _each(lambda: model.predict(q, loads)),
        "linear_form_s": _each(lambda: model.linear_form(q, loads)),
        "fit_s": _each(lambda: fit_linear(task.rigid(), q, loads, gap)),
    }


def _joints(n: int) -> dict[str, float]:
    """Time an arm of n alike joints, axes turned in and out, 0.2 m links of 2 kg."""
    c, s = 0.0, 1.0
    turns = [np.array([[1, 0, 0], [0, c, (-1) ** i * -s], [0, (-1) ** i * s, c]], dtype=float)
             for i in range(n + 1)]  # fmt: skip
    chain = Chain(
        np.array(turns), np.tile([0.1, 0.0, 0.17], (n + 1, 1)), np.eye(3), np.array([0, 0, 0.1]),
        np.full(n, 2.0), np.tile([0.05, 0.0, 0.08], (n, 1)), np.array([0, 0, -9.80665]),
        np.tile([1e-6, 1e-6, 5e-6], (n, 1)), np.zeros(n), np.zeros(n), np.zeros(3),
    )  # fmt: skip
    rng, count = np.random.default_rng(n), 4096
    rows = Rows(rng.uniform(-1, 1, (count, n)), np.ones((count, n)), np.full(count, 2.0),
                np.zeros((count, 3)), np.zeros((count, 6)))  # fmt: skip
    position, rotation = np.empty((count, 3)), np.empty((count, 3, 3))
    return {
        "joints": n,
        "predict_per_row_s": _each(lambda: predict(chain, rows, position, rotation)) / count,
        "setpoint_s": _setpoint(chain, n),
    }


def _setpoint(chain: Chain, n: int) -> float:
    """Return the time of one exact correction along a slow path."""
    from gapbridge.core.compensation import block_of

    block = block_of(chain, chain._replace(compliance=np.zeros((n, 3))))
    mass, cog, wrench = np.array([2.0]), np.zeros((1, 3)), np.zeros((1, 6))
    there = 0.6 + 0.2 * np.sin(0.004 * np.arange(200)[:, None] + np.arange(n))
    found = np.empty(n + 6)

    def run() -> None:
        for q in there:
            correct(block, q, mass, cog, wrench, found)

    return _each(run) / len(there)
