"""Numbers that are too many for memory, in a nameless file: written in order, read in order.

The median over all of them is exact: the sought value's bits are found from the most significant
ones on, a pass over the file for every sixteen.
"""

from __future__ import annotations

import tempfile
from types import TracebackType

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
BLOCK = 1 << 17  # numbers read at once
_BITS = 16


class Spool:
    """Rows of ``width`` numbers; a context that ends with its file."""

    def __init__(self, width: int) -> None:
        self.width = width
        self.rows = 0
        self._file = tempfile.TemporaryFile(prefix="gapbridge-")  # noqa: SIM115 - ours to close

    def __enter__(self) -> Spool:
        """Return the spool."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        """Drop the file."""
        self._file.close()

    def append(self, rows: Array) -> None:
        """Write further rows (k, width)."""
        self._file.write(np.ascontiguousarray(rows, dtype=float).tobytes())
        self.rows += len(rows)

    def rewind(self) -> None:
        """Begin to ``read`` anew."""
        self._file.seek(0)

    def read(self, rows: int) -> Array:
        """Return the next ``rows`` rows (fewer at the end)."""
        data = self._file.read(8 * self.width * rows)
        return np.frombuffer(data).reshape(-1, self.width)

    def median_size(self, first: int, last: int) -> float:
        """Return the median of the absolute values in columns first..last, as numpy's."""
        count = self.rows * (last - first)
        low, high = (self._ranked(rank, first, last) for rank in ((count - 1) // 2, count // 2))
        return 0.5 * (low + high)

    def _ranked(self, rank: int, first: int, last: int) -> float:
        """Return the absolute value that ``rank`` smaller ones precede."""
        prefix = 0
        for shift in range(64 - _BITS, -1, -_BITS):
            counts = np.zeros(1 << _BITS, dtype=np.int64)
            self.rewind()
            while len(rows := self.read(BLOCK // self.width + 1)):
                # absolute values order as their bits do
                bits = np.ascontiguousarray(np.abs(rows[:, first:last])).view(np.uint64).ravel()
                upper = np.uint64(shift + _BITS)
                if shift + _BITS < 64:
                    bits = bits[bits >> upper == np.uint64(prefix)]
                digits = (bits >> np.uint64(shift)) & np.uint64((1 << _BITS) - 1)
                counts += np.bincount(digits.astype(np.int64), minlength=1 << _BITS)
            below = np.cumsum(counts)
            digit = int(np.searchsorted(below, rank, side="right"))
            rank -= int(below[digit - 1]) if digit else 0
            prefix = prefix << _BITS | digit
        return float(np.array([prefix], dtype=np.uint64).view(np.float64)[0])
