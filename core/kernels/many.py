"""Many rows, by the quickest loop that can: blocks of lanes, or one row after the other."""

from __future__ import annotations

from numba import config

from gapbridge.core.arrays import Array
from gapbridge.core.kernels import reference as kernel
from gapbridge.core.kernels.predict import linear_blocks, predict_blocks
from gapbridge.core.kernels.reference import Chain, Rows
from gapbridge.core.kernels.threads import in_ranges

FEW = 2  # rows that are not worth a block


def _part(rows: Rows, first: int, last: int) -> Rows:
    return Rows(*(part[first:last] for part in rows))


def _singly(chain: Chain, rows: Rows) -> bool:
    """Return whether blocks cannot (links that bend), or would take longer (not compiled)."""
    return (
        len(rows.q) <= FEW
        or bool(chain.flexibility.any())
        or bool(getattr(config, "DISABLE_JIT", 0))
    )


def predict(chain: Chain, rows: Rows, position: Array, rotation: Array) -> int:
    """Write the TCP pose of every row; returns the first row without equilibrium, or -1."""
    if _singly(chain, rows):
        return int(kernel.predict_rows(chain, rows, position, rotation))

    def work(first: int, last: int) -> int:
        return int(predict_blocks(chain, rows, first, last, position, rotation))

    return next((bad for bad in in_ranges(work, len(rows.q)) if bad >= 0), -1)


def linear_form(chain: Chain, rows: Rows, A: Array, jacobian: Array, moment: Array) -> int:
    """Write the linear form of every row (``kernel.regressor_rows``); returns as ``predict``."""

    def singly(first: int, last: int) -> int:
        found = kernel.regressor_rows(
            chain, _part(rows, first, last), A[first:last], jacobian[first:last],
            moment[first:last],
        )  # fmt: skip
        return first + int(found) if found >= 0 else -1

    def work(first: int, last: int) -> int:
        stopped = int(linear_blocks(chain, rows, first, last, A, jacobian, moment))
        return -1 if stopped < 0 else singly(stopped, last)

    if _singly(chain, rows):
        return singly(0, len(rows.q))
    return next((bad for bad in in_ranges(work, len(rows.q)) if bad >= 0), -1)
