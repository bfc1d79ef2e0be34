"""Numbers in registers, worked out when a map is loaded, and compiled code that goes by it.

Takes the vectors of one block apart, all at once. What registers mean is the same as in
``Coding.decode``, which the tests compare with.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from gapbridge.core.kernels.reference import JIT
from gapbridge.drivers.modbus.registers import Coding

Array = NDArray[np.float64]
TURN = 2.0 * math.pi
UNSIGNED, SIGNED, MAGNITUDE, FLOAT = range(4)


@njit(**JIT)
def _float_of(bits, words):  # type: ignore[no-untyped-def]
    if words == 2:
        return np.float64(np.array([np.uint32(bits)]).view(np.float32)[0])
    return np.array([bits]).view(np.float64)[0]


@njit(**JIT)
def _taken(registers, places, found):  # type: ignore[no-untyped-def]
    """Write all numbers, SI; returns whether each is finite and within its bound.

    ``registers``: bytes, the high one of each first. ``places`` (m, 10): target, kind, words, adds
    to what is there, four registers, the high word first, SI units per count, bound: one array,
    because each is unwrapped anew in every call.
    """
    for k in range(places.shape[0]):
        target, kind, words = int(places[k, 0]), int(places[k, 1]), int(places[k, 2])
        bits = np.uint64(0)
        for i in range(words):
            at = 2 * int(places[k, 4 + i])
            word = np.uint64(registers[at]) << np.uint64(8) | np.uint64(registers[at + 1])
            bits = (bits << np.uint64(16)) | word
        top = np.uint64(1) << np.uint64(16 * words - 1)
        if kind == FLOAT:
            value = _float_of(bits, words)
        elif kind == MAGNITUDE and bits & top:
            value = -np.float64(bits & ~top)
        elif kind == SIGNED and bits & top:
            # two's complement; of 64 bits the cast alone is it
            value = np.float64(np.int64(bits | ~(top | (top - np.uint64(1)))))
        else:
            value = np.float64(bits)
        value *= places[k, 8]
        found[target] = found[target] + value if places[k, 3] != 0.0 else value
    fine = True
    for k in range(places.shape[0]):
        value, bound = found[int(places[k, 0])], places[k, 9]
        fine = fine and -bound <= value <= bound  # NaN is not either
    return fine


def kind_of(coding: Coding) -> int:
    """Return how the bits of a number are meant."""
    first = coding.type[:1]
    return MAGNITUDE if coding.type.startswith("sm") else {"i": SIGNED, "f": FLOAT}.get(first, 0)


class BlockPlan:
    """Vectors that lie in one block of registers."""

    def __init__(self, count: int) -> None:
        memory = bytearray(2 * count)
        self._memory = memoryview(memory)
        self._registers = np.frombuffer(memory, np.uint8)
        self._rows: list[tuple[float, ...]] = []
        self._limits: list[float] = []
        self._slices: list[tuple[str, slice]] = []
        self._compiled: Array = np.empty((0, 10))

    def add(
        self,
        name: str,
        indices: Sequence[int],
        coding: Coding,
        sizes: Sequence[float],
        bound: float,
    ) -> None:
        """Add a vector: its registers, SI units per count of each number, largest magnitude."""
        start = len(self._limits)
        end = start + len(sizes)
        self._limits += [bound] * (end - start)
        self._place(start, indices, coding, sizes, False)
        self._slices.append((name, slice(start, end)))

    def add_turns(self, indices: Sequence[int], coding: Coding) -> None:
        """Add the whole turns of the vector added last."""
        last = self._slices[-1][1]
        self._place(last.start, indices, coding, [TURN] * (last.stop - last.start), True)

    def _place(
        self,
        start: int,
        indices: Sequence[int],
        coding: Coding,
        sizes: Sequence[float],
        adds: bool,
    ) -> None:
        words = coding.words
        for i, size in enumerate(sizes):
            own = list(indices[i * words : (i + 1) * words])
            if coding.order == "low_first":
                own.reverse()
            row = (start + i, kind_of(coding), words, int(adds), *own, *[0] * (4 - words))
            self._rows.append((*row, size, self._limits[start + i]))

    def compile(self) -> None:
        """Make ready, once everything has been added: a first sample waits for no compiler."""
        self._compiled = np.array(self._rows, float).reshape(-1, 10)
        self.vectors(bytes(len(self._memory)))

    def vectors(self, registers: bytes) -> dict[str, Array] | None:
        """Return the vectors by name, SI; None where a number is not finite or implausible.

        ``registers``: two bytes each, as on the wire. Raises ValueError for more or fewer.
        """
        found = np.empty(len(self._limits))
        self._memory[:] = registers
        if not _taken(self._registers, self._compiled, found):
            return None
        return {name: found[where] for name, where in self._slices}
