"""Many rows: the fit of twelve flexibilities from rows never stored."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
from scipy.linalg import lstsq

from benchmarks.speed import task
from benchmarks.speed.linear_fit import fit_linear
from benchmarks.speed.peers.cpp import Cpp, compiler
from benchmarks.speed.sides import Side, compared, interleaved

OURS, THREADS = "ours", "ours, all threads"


def fit(count: int, rounds: int) -> dict[str, Any]:
    """Return the row of the fit, ours with the regressor, scipy's without; times of one row."""
    model, (q, loads) = task.rigid(), task.rows(count)
    chain, rows = model.chain(), model.rows(q, loads)
    stored = model.linear_form(q, loads).regressor[:, :3].reshape(-1, 12)
    truth = np.concatenate([task.AXIAL, task.RADIAL])
    noise = np.random.default_rng(2).normal(0, 2e-5, (count, 3))
    gap = (stored @ truth).reshape(-1, 3) + noise
    right, G = gap.ravel(), np.zeros((13, 13))
    peer = "scipy lstsq, stored rows, solve alone"
    sides = [
        Side(OURS, lambda: _single(lambda: fit_linear(model, q, loads, gap)), count),
        Side(THREADS, lambda: fit_linear(model, q, loads, gap), count),
        Side(peer, lambda: lstsq(stored, right), count),
    ]  # fmt: skip
    pairs = [(peer, OURS)]
    if compiler():
        cpp = Cpp(chain)
        sides.append(Side("C++, fused normal equations", lambda: cpp.normal(rows, gap, G), count))
        pairs.append(("C++, fused normal equations", OURS))
    figures = interleaved(sides, rounds)
    Q, R = np.linalg.qr(stored)
    by_qr = np.linalg.solve(R, Q.T @ right)
    del Q
    found = fit_linear(model, q, loads, gap)
    tracemalloc.start()
    fit_linear(model, q, loads, gap)
    ours_memory = tracemalloc.get_traced_memory()[1]
    tracemalloc.reset_peak()
    lstsq(stored, right)
    peer_memory = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return compared(
        f"fit of 12 flexibilities from {count} rows",
        "5 times scipy's solve alone, under 10 MB over the inputs, 1e-9 of QR", figures, pairs,
        memory_MB={"ours": ours_memory / 1e6, "scipy": peer_memory / 1e6,
                   "stored rows": stored.nbytes / 1e6},
        off_qr=float(np.abs(found.flexibility / by_qr - 1).max()), condition=found.condition,
    )  # fmt: skip


def _single(work: Any) -> None:
    """Do the work on the calling thread alone."""
    from gapbridge.core.kernels import threads

    kept, threads.processors = threads.processors, lambda: 1
    try:
        work()
    finally:
        threads.processors = kept
