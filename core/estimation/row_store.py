"""Rows that are read once and passed over often: in memory up to a size, beyond it in a file."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.estimation.compliance_fit import Data
from gapbridge.core.loads import Loads

KEPT = 128 << 20  # bytes in memory


class RowStore:
    """Blocks of rows with measured poses, and where each row stands in the log."""

    def __init__(self, kept: int = KEPT) -> None:
        self.count = 0
        self._free = kept
        self._blocks: list[tuple[Data, NDArray[np.int64]]] = []
        self._file: Any = None

    def append(self, data: Data, rows: NDArray[np.int64]) -> None:
        """Keep a block; ``rows`` (k,) are the numbers of its rows, from 0."""
        given = {f.name: getattr(data.loads, f.name) for f in fields(Loads)}
        loads = Loads(**{k: None if v is None else self._kept(v) for k, v in given.items()})
        self._blocks.append((
            replace(
                data, q=self._kept(data.q), position=self._kept(data.position), loads=loads,
                rotation=None if data.rotation is None else self._kept(data.rotation),
            ),
            self._kept(rows),
        ))  # fmt: skip
        self.count += len(rows)

    def __iter__(self) -> Iterator[tuple[Data, NDArray[np.int64]]]:
        """Yield the blocks in the order in which they came."""
        return iter(self._blocks)

    def _kept(self, values: NDArray[Any]) -> NDArray[Any]:
        if (
            len(values) and (values == values[0]).all()
        ):  # one payload's centre: a row counts for all
            return np.broadcast_to(values[:1].copy(), values.shape)
        if values.nbytes <= self._free:
            self._free -= values.nbytes
            return values
        if self._file is None:
            self._file = tempfile.TemporaryFile(prefix="gapbridge-")  # noqa: SIM115 - lives as long
        at = self._file.seek(0, 2)
        self._file.write(np.ascontiguousarray(values).tobytes())
        self._file.flush()
        return np.memmap(self._file, values.dtype, "r", at, values.shape)
