"""Many rows: the regressor, and the fit of twelve flexibilities from rows never stored."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
from scipy.linalg import lstsq

from benchmarks.speed import task
from benchmarks.speed.linear_fit import fit_linear
from benchmarks.speed.peers import numpy_task
from benchmarks.speed.peers.cpp import Cpp, compiler
from benchmarks.speed.peers.pinocchio_task import PinocchioTask
from benchmarks.speed.sides import Side, compared, interleaved
from gapbridge.core.kernels.factor import regressor_blocks
from gapbridge.core.kernels.threads import in_ranges

OURS, THREADS = "ours", "ours, all threads"
NUMPY, C, PINOCCHIO = "plain numpy, blocks", "C++ (vectors of eight)", "Pinocchio, loop"
LOOPED = 500  # rows of the Pinocchio loop, whose time grows with the rows and nothing else


def regressor(count: int, rounds: int) -> dict[str, Any]:
    """Return the row of the regressor of ``count`` rows, stored; times are of one row."""
    model, (q, loads) = task.rigid(), task.rows(count)
    chain, rows = model.chain(), model.rows(q, loads)
    A, other = np.zeros((12, 3, count)), np.zeros((12, 3, count))
    pin = PinocchioTask(chain, model.rows(q[:1], loads[:1]))

    def loop() -> None:
        for r in range(LOOPED):
            pin.regressor(q[r], rows.wrench[r])

    sides = [
        Side(OURS, lambda: regressor_blocks(chain, rows, 0, count, A), count),
        Side(THREADS, lambda: in_ranges(
            lambda first, last: regressor_blocks(chain, rows, first, last, A), count), count),
        Side(NUMPY, lambda: numpy_task.regressor(chain, rows, other), count),
        Side(PINOCCHIO, loop, LOOPED),
    ]  # fmt: skip
    if compiler():
        cpp = Cpp(chain)
        sides.append(Side(C, lambda: cpp.regressor(rows, other), count))
    figures = interleaved(sides, rounds)
    _agree(A, other, pin, rows)
    pairs = [(side.name, OURS) for side in sides[2:]]
    return compared(f"regressor for {count} rows", "within 4 times of C++", figures, pairs)


def _agree(A: np.ndarray, other: np.ndarray, pin: PinocchioTask, rows: Any) -> None:
    np.testing.assert_allclose(A, other, rtol=0, atol=1e-12 * np.abs(A).max())
    for r in range(5):
        expected = pin.regressor(rows.q[r], rows.wrench[r])[0].T
        np.testing.assert_allclose(A[:, :, r], expected, rtol=0, atol=1e-12 * np.abs(A).max())


def fit(count: int, rounds: int) -> dict[str, Any]:
    """Return the row of the fit, ours with the regressor, scipy's without; times of one row."""
    model, (q, loads) = task.rigid(), task.rows(count)
    form = np.zeros((12, 3, count))
    chain, rows = model.chain(), model.rows(q, loads)
    regressor_blocks(chain, rows, 0, count, form)
    stored = np.ascontiguousarray(form.transpose(2, 1, 0).reshape(-1, 12))
    del form
    truth = np.concatenate([task.AXIAL, task.RADIAL])
    noise = np.random.default_rng(2).normal(0, 2e-5, (count, 3))
    gap = (stored @ truth).reshape(-1, 3) + noise
    right, G = gap.ravel(), np.zeros((13, 13))
    peer = "scipy lstsq, stored rows, solve alone"
    sides = [
        Side(OURS, lambda: _single(lambda: fit_linear(model, q, loads, gap)), count),
        Side("ours, R factor",
             lambda: _single(lambda: fit_linear(model, q, loads, gap, factored=True)), count),
        Side(THREADS, lambda: fit_linear(model, q, loads, gap), count),
        Side(peer, lambda: lstsq(stored, right), count),
    ]  # fmt: skip
    pairs = [(peer, OURS), (peer, "ours, R factor")]
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
